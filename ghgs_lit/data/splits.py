"""Splits of subjects into ``train`` and ``val``: from files, lists and ranges, or by a fraction."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ghgs_lit.data.reader import PHASES
from ghgs_lit.errors import InputError
from ghgs_lit.readers import read_json, read_text

_LISTS = tuple(f"split_{phase}.txt" for phase in PHASES)
_SPLIT_FILES = ("splits.json", _LISTS[0])

Split = str | Path | Mapping[str, Sequence[str]]


def split_names(
    source: Path, names: Sequence[str], split: Split | None, val_fraction: float, seed: int
) -> dict[str, list[str]]:
    """Divide the scans of a folder. ``split``: as for :func:`read_split` (None: the split files in
    ``source``, if any). ``val_fraction``: share of ``names`` for ``val`` without a split, at least one if
    above 0. InputError: the split is missing or malformed, names scans that do not exist, or overlaps."""
    if split is None and not any((source / name).exists() for name in _SPLIT_FILES):
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
    """Ids of ``train`` and ``val`` (which a split may call ``test``). ``split``: a JSON file with these
    lists; a folder with ``splits.json``, or with ``split_train.txt`` and ``split_val.txt`` (one id a line);
    or a mapping to ids and ranges of ``names`` such as ``0000-0425``. InputError: it is missing or malformed,
    or an id is in both."""
    if isinstance(split, Mapping):
        place: Path | str = "data.split"
        chosen = _lists(place, split)
        chosen = {
            phase: [n for entry in listed for n in _expand(entry, names)] for phase, listed in chosen.items()
        }
    else:
        folder = place = Path(split).expanduser()
        if folder.is_dir():
            place = next((p for n in _SPLIT_FILES if (p := folder / n).exists()), folder)
        if not place.is_file() or (place.suffix != ".json" and place.name not in _LISTS):
            raise InputError(f"{place}: expected a JSON file or a folder with split_train.txt; found neither")
        chosen = _read_split(place)
    if both := sorted(set(chosen["train"]) & set(chosen["val"])):
        raise InputError(f"{place}: expected disjoint train and val; found {both[0]!r} in both")
    return chosen


def _expand(entry: object, names: Sequence[str]) -> list[str]:
    """The id, or all of ``names`` in a range of ids of equal length."""
    first, dash, last = str(entry).partition("-")
    if not dash:
        return [str(entry)]
    return [name for name in names if len(name) == len(first) and first <= name <= last]


def _lists(place: Path | str, content: Mapping) -> dict[str, list]:
    chosen = {"train": content.get("train"), "val": content.get("val", content.get("test"))}
    for phase, listed in chosen.items():
        is_list = isinstance(listed, Sequence) and not isinstance(listed, str)
        if not is_list or not all(isinstance(entry, str | int) for entry in listed):
            raise InputError(f"{place}: expected a list {phase!r} (test does for val); found {listed!r}")
    return {phase: list(listed) for phase, listed in chosen.items()}


def _read_split(path: Path) -> dict[str, list[str]]:
    if path.suffix == ".json":
        content = read_json(path)
        return _lists(path, content if isinstance(content, Mapping) else {})
    result = {}
    for phase in PHASES:
        file = path.with_name(f"split_{phase}.txt")
        result[phase] = read_text(file, "one id a line").split()
    return result
