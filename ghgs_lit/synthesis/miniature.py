"""``ghgs prepare task=miniature``: a small data set of built-in people in a published layout."""

from collections.abc import Callable, Mapping
from pathlib import Path

from ghgs_lit.data.dataset import DataSet, required_folder
from ghgs_lit.data.humman.dataset import HuMMan
from ghgs_lit.data.zju_mocap.dataset import ZJUMoCap
from ghgs_lit.errors import InputError
from ghgs_lit.synthesis.miniatures import humman, thuman2, zju_mocap
from ghgs_lit.synthesis.thuman2 import THuman2


def make_miniature(dataset: DataSet, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    """Write a small data set that the reader of ``dataset`` reads.

    Args:
        dataset: says which layout, and where it is written.
        people: number of people of each phase.
        size: longer side of the photographs in pixels.
        seed: seed of the people.

    Returns:
        The folders that were written.

    Raises:
        InputError: no layout is published for the data set, or it has no folder.
    """
    for kind, make in _MAKERS.items():
        if isinstance(dataset, kind):
            return make(dataset, people, size, seed)
    raise InputError(f"task=miniature: expected a data set with a published layout; found {dataset.name}")


def _root(dataset: DataSet) -> Path:
    return required_folder("data.root", "a folder to write to", dataset.root)


def _zju_mocap(dataset: ZJUMoCap, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    chosen = []
    for phase, splits in dataset.splits.items():
        chosen += [s for split in splits for s in split.sequences][: people[phase]]
    return zju_mocap.make(_root(dataset), chosen, size, seed)


def _humman(dataset: HuMMan, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    return humman.make(_root(dataset), dataset.split["val"], people, size, seed)


def _thuman2(dataset: THuman2, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    """Raw scans in ``source`` if it is given, else renders in ``root`` as the published scripts make them."""
    if dataset.source is not None:
        return [thuman2.make_raw(dataset.source_folder, people, size, seed)]
    if dataset.root is None:
        raise InputError("data.root: expected a folder for renders, or data.source for scans; found none")
    return [thuman2.make(_root(dataset), people, size, seed)]


_MAKERS: dict[type[DataSet], Callable[..., list[Path]]] = {
    HuMMan: _humman,
    THuman2: _thuman2,
    ZJUMoCap: _zju_mocap,
}
