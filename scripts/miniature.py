"""Write a small data set of built-in people in a published layout, to try its loader.

    python scripts/miniature.py data=humman data.root=humman --train 2 --val 2

Keys are those of ``ghgs prepare``: ``data`` selects the layout, ``data.root`` the folder.
``data=thuman2 data.source=my_scans`` writes raw scans, ``data.root`` renders of them. A folder with
anything but a miniature is rejected. Prints the folders that were written.
"""

import argparse
import sys
from collections.abc import Callable, Mapping
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from ghgs_lit.config import build, compose
from ghgs_lit.data.dataset import DataSet, required_folder
from ghgs_lit.data.humman import HuMMan
from ghgs_lit.data.reader import PHASES
from ghgs_lit.data.zju_mocap import ZJUMoCap
from ghgs_lit.errors import InputError
from ghgs_people.thuman2 import THuman2
from scripts.miniatures import humman, scans, thuman2, zju_mocap
from scripts.miniatures.scans import mark


def make_miniature(dataset: DataSet, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    """Write a small data set for the reader of ``dataset``.

    Args:
        people: number of people of each phase.
        size: longer side of the photographs in pixels.

    Returns:
        The folders that were written.

    Raises:
        InputError: the data set has no published layout or no folder, or the folder has anything but
            a miniature.
    """
    for kind, make in _MAKERS.items():
        if isinstance(dataset, kind):
            return make(dataset, people, size, seed)
    raise InputError(f"miniature: expected a data set with a published layout; found {dataset.name}")


def _root(dataset: DataSet) -> Path:
    return required_folder("data.root", "a folder to write to", dataset.root)


def _zju_mocap(dataset: ZJUMoCap, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    chosen = []
    for phase in PHASES:
        chosen += [s for some in getattr(dataset.split, phase) for s in some.sequences][: people[phase]]
    root = _root(dataset)
    mark(root)
    return zju_mocap.make(root, chosen, size, seed)


def _humman(dataset: HuMMan, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    root = _root(dataset)
    mark(root, humman.body_models(root))
    return humman.make(root, dataset.split.val, people, size, seed)


def _thuman2(dataset: THuman2, people: Mapping[str, int], size: int, seed: int) -> list[Path]:
    """Write renders as the published scripts do; with ``data.source``, raw scans with their fits."""
    if dataset.source is not None:
        source = dataset.source_folder
        mark(source, scans.fit_folder(source))
        return [scans.make_scans(source, people, size, seed)]
    root = _root(dataset)
    mark(root)
    return [thuman2.make(root, people, size, seed)]


_MAKERS: dict[type[DataSet], Callable[..., list[Path]]] = {
    HuMMan: _humman,
    THuman2: _thuman2,
    ZJUMoCap: _zju_mocap,
}


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--train", type=int, default=4, help="people of training")
    parser.add_argument("--val", type=int, default=2, help="people of validation")
    parser.add_argument("--size", type=int, default=256, help="longer side of photographs, half of textures'")
    given, overrides = parser.parse_known_args()
    cfg, people = compose("prepare", overrides), {"train": given.train, "val": given.val}
    data = build(cfg.data, key="data", views=cfg.views, targets=cfg.targets, seed=cfg.seed)
    for folder in make_miniature(data.dataset, people, given.size, cfg.seed):
        print(f"wrote {folder}")


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"miniature: {error}")
