"""Runs as one frame: row of the table, setting, and metrics of each subject.

A run is identified by its configuration, never by the name of its directory.
"""

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from pydantic import BaseModel, ConfigDict, Field

from ghgs_lit.config.keys import flatten, is_below, lookup
from ghgs_lit.errors import InputError, require
from ghgs_lit.evaluation.tables.variants import (
    TRAINING_COUNTS,
    Variant,
    find_keys_of_rows,
    find_views_of_columns,
    name_variants,
)
from ghgs_lit.parsing import read_yaml
from ghgs_lit.runs.results import METHOD, read_results, validate
from ghgs_lit.runs.run import runs_in_order

SETTING = ["data", "split", "targets", "protocol"]
"""Columns whose values all numbers in a column of a table share."""
TRAINING = {"steps": ("steps", 1), "seconds": ("seconds", 1), "peak_gb": ("peak_bytes", 1e9)}
"""Metrics of the training, which are not per subject: key in the provenance, and divisor to the
printed unit."""


class Planned(NamedTuple):
    """A training run without results: its row, data set, numbers of input views (None: unknown) and
    seed."""

    variant: Variant
    data: str
    views: tuple[int, ...] | None
    seed: int


@dataclass
class Sweep:
    """All runs below the directories of a sweep.

    Attributes:
        rows: One for each run, method, number of views, target protocol and subject, with
            ``variant``, ``SETTING``, ``views``, ``seed``, ``source`` (the file), ``run`` (the
            configuration's hash), ``git`` (in words), ``subject``, and the metrics, averaged over the
            subject's targets; and ``trained_views``, the number of views in training of models that
            share a row and were each trained with a different one.
        planned: Training runs without results.
        configs: Configuration of our model by ``source``.
        order: Variants of our models in the order of rows.
    """

    rows: pd.DataFrame
    planned: list[Planned]
    configs: dict[str, Mapping[str, Any]]
    order: list[Variant]


class _Strict(BaseModel):
    model_config = ConfigDict(strict=True)


class _Data(_Strict):
    name: str
    split: str


class _Protocol(_Strict):
    metrics: str


class _Git(_Strict):
    commit: str
    changed: bool = False


class _Training(_Strict):
    steps: float | None = None
    seconds: float | None = None
    peak_bytes: float | None = None


class _Provenance(_Strict):
    config: dict[str, Any]
    config_hash: str | None = None
    # Written by `ghgs evaluate`: the training's configuration, and its changes on the command line.
    checkpoint_config: dict[str, Any] | None = None
    changed_model: dict[str, Any] | None = Field(None, alias="model_config")
    seed: int | None = None
    data: _Data
    protocol: _Protocol
    git: _Git | None = None
    training: _Training | None = None


def _read_run(path: Path) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Rows of a ``metrics.json``, without ``variant``, and the configuration of its model as trained
    and measured."""
    content = read_results(path)
    source = validate(_Provenance, content["provenance"], f"{path}: provenance")
    trained = (source.checkpoint_config or source.config) | (source.changed_model or {})
    of_evaluation = ("checkpoint", "refine", "refine_cameras", "data", "metrics")
    config = trained | {key: source.config[key] for key in of_evaluation if key in source.config}
    measured = source.config.get("targets")
    if isinstance(measured, Mapping) and isinstance(trained.get("targets"), Mapping):
        of_training = {key: trained["targets"].get(key) for key in ("training_views", "per_step")}
        config["targets"] = {**measured, **of_training}
    seed = trained.get("seed", source.seed)
    require(isinstance(seed, int), f"{path}: provenance.seed", "a whole number", seed)
    rows = pd.DataFrame(content["rows"]).drop(columns=["target", "inputs", "skip"], errors="ignore")
    # In tables, ``seconds`` is the training time.
    of_row = ["method", "views", "targets", "subject"]
    rows = rows.rename(columns={"seconds": "prediction_seconds"}).set_index(of_row).astype(float)
    rows = rows.groupby(level=of_row, sort=False).mean().dropna(axis="columns", how="all").reset_index()
    for name, (key, unit) in TRAINING.items():
        value = getattr(source.training, key, None)
        if value is not None:
            rows[name] = (rows["method"] == METHOD).map({True: value / unit})
    git = source.git and source.git.commit[:9] + " with changes" * source.git.changed
    about = {"seed": seed, "source": str(path), "run": source.config_hash, "git": git}
    about |= {"data": source.data.name, "split": source.data.split, "protocol": source.protocol.metrics}
    return rows.assign(**about), config


def _read_training(path: Path) -> dict[str, Any] | None:
    """The ``config.yaml`` of a training run; None: it belongs to another command or is incomplete."""
    try:
        config = read_yaml(path)
    except InputError:
        return None
    needed = ("trainer", "data", "recalibration")
    if not isinstance(config, Mapping) or not all(key in config for key in needed):
        return None
    require(isinstance(config.get("seed", 0), int), f"{path}: seed", "a whole number", config.get("seed"))
    return config


def natural_sort_key(text: str) -> list[str | float]:
    """Sort key that compares numbers in texts by value: ``k=10`` comes after ``k=9``."""
    parts = re.split(r"(\d+(?:\.\d+)?(?:e[-+]?\d+)?)", text)
    return [float(part) if i % 2 else part for i, part in enumerate(parts)]


def _sort_paths(paths: Iterable[str], folders: Sequence[Path], variants: Mapping[str, Variant]) -> list[str]:
    """Sort files of runs by folder, then as in the sweep's command, then by the names of their rows."""
    commands = {sweep: runs_in_order(sweep) for sweep in {Path(path).parent.parent for path in paths}}

    def place(path: str) -> tuple:
        run = Path(path).parent
        folder = [run.is_relative_to(folder) for folder in folders].index(True)
        names = commands[run.parent]
        number = names.index(run.name) if run.name in names else len(names)
        return (
            folder,
            natural_sort_key(str(run.parent)),
            number,
            natural_sort_key(str(variants.get(path))),
            natural_sort_key(path),
        )

    return sorted(paths, key=place)


def _find_files(folders: Sequence[Path], name: str) -> list[Path]:
    paths = itertools.chain.from_iterable(sorted(folder.rglob(name)) for folder in folders)
    return [path for path in paths if path.parent.name != ".hydra"]


def read_sweep(folders: Sequence[Path], by: Sequence[str] = ()) -> Sweep:
    """Read all runs below folders, finished or not.

    Args:
        folders: Directories of sweeps or runs.
        by: Configuration keys that distinguish rows beyond model, encoder, ablation and the views and
            targets of the training.

    Raises:
        FileNotFoundError: A folder is missing.
        InputError: There is no finished run, a ``metrics.json`` is damaged, or no run has a key of
            ``by``.
    """
    for folder in folders:
        if not folder.is_dir():
            found = "a file" if folder.is_file() else "none"
            raise FileNotFoundError(f"{folder}: expected a directory of runs; found {found}")
    runs = {str(path): _read_run(path) for path in _find_files(folders, "metrics.json")}
    trainings = {str(path): _read_training(path) for path in _find_files(folders, "config.yaml")}
    trainings = {path: config for path, config in trainings.items() if config is not None}
    if not runs:
        names = ", ".join(map(str, folders))
        begun = f"{len(trainings)} runs without one" if trainings else "none"
        raise InputError(f"{names}: expected runs with a metrics.json below it; found {begun}")
    models = {source: config for source, (rows, config) in runs.items() if METHOD in set(rows["method"])}
    known = set().union(*(flatten(config) for _, config in runs.values()))
    for key in by:
        require(any(is_below(k, [key]) for k in known), "by", "keys of the runs' configurations", key)
    configs = {**models, **trainings}
    views = {} if TRAINING_COUNTS in by else find_views_of_columns(configs)
    for path in views:  # one row, whatever the number of views in training
        configs[path] = {**configs[path], "views": {**configs[path]["views"], "training_counts": "as many"}}
    variants = name_variants(configs, list(dict.fromkeys([*by, *find_keys_of_rows(configs.values())])))
    frames = []
    planned = []
    paths = _sort_paths({**runs, **trainings}, folders, variants)
    for path in paths:
        if path in runs:
            rows = runs[path][0]
            if path in views:
                rows = rows[(rows["method"] != METHOD) | (rows["views"] == views[path])]
            of_rows = [
                variants[path] if name == METHOD else Variant("baseline", name) for name in rows["method"]
            ]
            trained_views = float(views.get(path, "nan"))
            frames.append(rows.drop(columns="method").assign(variant=of_rows, trained_views=trained_views))
        elif str(Path(path).with_name("metrics.json")) not in runs:
            config = trainings[path]
            counts = views.get(path, lookup(config, "evaluation.views"))
            counts = (counts,) if isinstance(counts, int) else counts and tuple(counts)
            planned.append(
                Planned(variants[path], str(lookup(config, "data.name")), counts, config.get("seed", 0))
            )
    order = list(dict.fromkeys(variants[path] for path in paths if path in variants))
    return Sweep(pd.concat(frames, ignore_index=True), planned, models, order)
