"""``ghgs prepare task=miniature``: a small data set of built-in people in a published layout.

A folder that is written gets the marker ``miniature.json``, which lists its files, so that real data of the
same names is never overwritten.
"""

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from ghgs_lit.data.dataset import DataSet, required_folder
from ghgs_lit.data.humman.dataset import HuMMan
from ghgs_lit.data.reader import PHASES
from ghgs_lit.data.zju_mocap.dataset import ZJUMoCap
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_text_atomically
from ghgs_lit.readers import read_json
from ghgs_lit.synthesis.miniatures import humman, thuman2, zju_mocap
from ghgs_lit.synthesis.thuman2 import THuman2

#: In each folder that a miniature was written to: which files are its own.
MARKER = "miniature.json"


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
        InputError: no layout is published for the data set, it has no folder, or files lie there that are not
            a miniature's.
    """
    for kind, make in _MAKERS.items():
        if isinstance(dataset, kind):
            return make(dataset, people, size, seed)
    raise InputError(f"task=miniature: expected a data set with a published layout; found {dataset.name}")


def _root(dataset: DataSet) -> Path:
    return required_folder("data.root", "a folder to write to", dataset.root)


@contextlib.contextmanager
def _writing(*folders: Path) -> Iterator[None]:
    """Refuse folders that hold anything but a miniature; mark as its own what is written into them.

    Raises:
        InputError: a folder holds other files.
    """
    for folder in folders:
        _check_own(folder)
    for folder in folders:
        _mark(folder, None)
    yield
    for folder in folders:
        _mark(folder, _files(folder))


def _files(folder: Path) -> list[str]:
    return sorted(
        p.relative_to(folder).as_posix() for p in folder.rglob("*") if not p.is_dir() and p.name != MARKER
    )


def _mark(folder: Path, files: list[str] | None) -> None:
    """Note the files of a miniature; None while they are written, so that a killed run can be repeated."""
    write_text_atomically(folder / MARKER, json.dumps({"files": files}, indent=1))


def _check_own(folder: Path) -> None:
    """Refuse a folder with files that no miniature wrote."""
    marker = folder / MARKER
    found = _files(folder) if folder.is_dir() else []
    if marker.is_file():
        content = read_json(marker, "a miniature's list of its files")
        own = content.get("files") if isinstance(content, dict) else "no mapping"
        is_list = isinstance(own, list) and all(isinstance(name, str) for name in own)
        require(own is None or is_list, f"{marker}: files", "a list of names or null", own)
        found = [] if own is None else sorted(set(found) - set(own))
    if found:
        raise InputError(
            f"{folder}: expected an empty folder, or a miniature and nothing else; found "
            f"{len(found)} other files such as {found[0]}"
        )


def _zju_mocap(dataset: ZJUMoCap, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    chosen = []
    for phase in PHASES:
        chosen += [s for some in dataset.split.of(phase) for s in some.sequences][: people[phase]]
    root = _root(dataset)
    with _writing(root):
        return zju_mocap.make(root, chosen, size, seed)


def _humman(dataset: HuMMan, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    root = _root(dataset)
    with _writing(root, humman.body_models(root)):
        return humman.make(root, dataset.split.val, people, size, seed)


def _thuman2(dataset: THuman2, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    """Raw scans in ``source`` if it is given, else renders in ``root`` as the published scripts make them."""
    if dataset.source is not None:
        source = dataset.source_folder
        with _writing(source, thuman2.fit_folder(source)):
            return [thuman2.make_raw(source, people, size, seed)]
    if dataset.root is None:
        raise InputError("data.root: expected a folder for renders, or data.source for scans; found none")
    root = _root(dataset)
    with _writing(root):
        return [thuman2.make(root, people, size, seed)]


_MAKERS: dict[type[DataSet], Callable[..., list[Path]]] = {
    HuMMan: _humman,
    THuman2: _thuman2,
    ZJUMoCap: _zju_mocap,
}
