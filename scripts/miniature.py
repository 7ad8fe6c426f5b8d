"""A small data set of built-in people in a published layout, to try its loader without the real data.

    python scripts/miniature.py data=humman data.root=humman miniature.people.train=2 miniature.people.val=2

Takes the keys of ``ghgs prepare``: ``data`` says which layout, ``data.root`` where. A folder that holds
anything but a miniature is refused. Prints the folders that were written.
"""

import sys
from collections.abc import Callable, Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from ghgs_lit.config import build, compose
from ghgs_lit.data.dataset import DataSet, required_folder
from ghgs_lit.data.humman.dataset import HuMMan
from ghgs_lit.data.reader import PHASES
from ghgs_lit.data.zju_mocap.dataset import ZJUMoCap
from ghgs_lit.errors import InputError
from ghgs_lit.synthesis.miniature import writing
from ghgs_lit.synthesis.thuman2 import THuman2
from scripts.miniatures import humman, thuman2, zju_mocap


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
            return make(dataset, _root(dataset), people, size, seed)
    raise InputError(f"miniature: expected a data set with a published layout; found {dataset.name}")


def _root(dataset: DataSet) -> Path:
    return required_folder("data.root", "a folder to write to", dataset.root)


def _zju_mocap(dataset: ZJUMoCap, root: Path, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    chosen = []
    for phase in PHASES:
        chosen += [s for some in dataset.split.of(phase) for s in some.sequences][: people[phase]]
    with writing(root):
        return zju_mocap.make(root, chosen, size, seed)


def _humman(dataset: HuMMan, root: Path, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    with writing(root, humman.body_models(root)):
        return humman.make(root, dataset.split.val, people, size, seed)


def _thuman2(dataset: THuman2, root: Path, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    """Renders as the published scripts make them; scans are those of ``ghgs prepare task=miniature``."""
    with writing(root):
        return [thuman2.make(root, people, size, seed)]


_MAKERS: dict[type[DataSet], Callable[..., list[Path]]] = {
    HuMMan: _humman,
    THuman2: _thuman2,
    ZJUMoCap: _zju_mocap,
}


def main() -> None:
    """The command."""
    cfg = compose("prepare", sys.argv[1:])
    data = build(cfg.data, key="data", views=cfg.views, targets=cfg.targets, seed=cfg.seed)
    miniature = cfg.miniature
    for folder in make_miniature(data.dataset, dict(miniature.people), miniature.size, cfg.seed):
        print(f"wrote {folder}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"miniature: {error}")
