"""Splits of subjects into ``train`` and ``val``: from files, lists and ranges, or by a fraction."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ghgs_lit.data.reader import PHASES
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import read_text, require_folder

Split = str | Path | Mapping[str, Sequence[str] | None]


def split_names(
    source: Path, names: Sequence[str], split: Split | None, val_fraction: float, seed: int
) -> dict[str, list[str]]:
    """Divide the scans of a folder into ``train`` and ``val``.

    Args:
        source: folder of the scans.
        names: ids of all scans.
        split: see :func:`read_split`; None: the split files in ``source``, or a random split if there are
            none.
        val_fraction: share of ``names`` in ``val`` for a random split, in [0, 1]; at least one scan if
            above 0.
        seed: seed of a random split.

    Returns:
        Ids by phase.

    Raises:
        InputError: the split is missing or malformed, names scans that do not exist, or overlaps.
    """
    if split is None and not (source / "split_train.txt").exists():
        order = np.random.default_rng(seed).permutation(len(names))
        count = max(round(val_fraction * len(names)), val_fraction > 0)
        return {
            "train": [names[i] for i in sorted(order[count:])],
            "val": [names[i] for i in sorted(order[:count])],
        }
    chosen = read_split(source if split is None else split, names)
    for phase, listed in chosen.items():
        if unknown := sorted(set(listed) - set(names)):
            raise InputError(
                f"{split or source}: expected ids of scans in {source}; found {unknown[0]!r} in {phase}"
            )
    return chosen


def read_split(split: Split, names: Sequence[str]) -> dict[str, list[str]]:
    """Read the ids of ``train`` and ``val``.

    Args:
        split: a folder with ``split_train.txt`` and ``split_val.txt`` (one id per line), or a mapping
            from phases to ids and to ranges of ``names`` such as ``0000-0425``.
        names: ids of all scans.

    Raises:
        InputError: the split is missing or malformed, or an id is in both phases.
    """
    if isinstance(split, Mapping):
        place: Path | str = "data.split"
        for phase in PHASES:
            require(split.get(phase) is not None, place, f"a list {phase!r}", split.get(phase))
        chosen = {}
        for phase in PHASES:
            chosen[phase] = []
            for entry in split[phase]:
                chosen[phase] += _expand(entry, names)
    else:
        place = Path(split).expanduser()
        require_folder(place, "a folder with split_train.txt and split_val.txt")
        chosen = {p: read_text(place / f"split_{p}.txt", "one id a line").split() for p in PHASES}
    if both := sorted(set(chosen["train"]) & set(chosen["val"])):
        raise InputError(f"{place}: expected disjoint train and val; found {both[0]!r} in both")
    return chosen


def _expand(entry: str, names: Sequence[str]) -> list[str]:
    """Expand a range of ids to all ``names`` of equal length in it; other entries are ids themselves."""
    first, dash, last = entry.partition("-")
    if not dash:
        return [entry]
    return [name for name in names if len(name) == len(first) and first <= name <= last]
