"""Runs and results of other methods as frames: row of the table, setting, and metrics of each subject.

A run is identified by its configuration, never by the name of its directory.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import pandas as pd
from pydantic import AliasPath, BaseModel, ConfigDict, Field, FiniteFloat

from ghgs_lit.config.keys import flatten, is_below, lookup
from ghgs_lit.errors import InputError, require
from ghgs_lit.evaluation.tables.variants import (
    TRAINING_COUNTS,
    Variant,
    find_keys_of_rows,
    find_views_of_columns,
    model_variant,
)
from ghgs_lit.parsing import read_json, read_yaml
from ghgs_lit.runs.results import METHOD, read_results, validate
from ghgs_lit.runs.run import runs_in_order

SETTING = ["data", "split", "targets", "protocol"]
"""Columns whose values all numbers in a column of a table share."""
TRAINING = {"steps": ("steps", 1), "seconds": ("seconds", 1), "peak_gb": ("peak_bytes", 1e9)}
"""Metrics of the training, which are not per subject: key in the provenance, and divisor to the
printed unit."""


class Planned(NamedTuple):
    """A training run without results: its row, data set, numbers of input views and seed."""

    variant: Variant
    data: str
    views: tuple[int, ...]
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
    """

    rows: pd.DataFrame
    planned: list[Planned]
    configs: dict[str, Mapping[str, Any]]


class _Provenance(BaseModel):
    """Provenance of a ``metrics.json``, as far as tables need it."""

    model_config = ConfigDict(strict=True)
    config: dict[str, Any]
    config_hash: str | None = None
    # Written by `ghgs evaluate`: the training's configuration, and its changes on the command line.
    checkpoint_config: dict[str, Any] | None = None
    changed_model: dict[str, Any] | None = Field(None, alias="model_config")
    seed: int | None = None
    data: Annotated[str, Field(validation_alias=AliasPath("data", "name"))]
    split: Annotated[str, Field(validation_alias=AliasPath("data", "split"))]
    protocol: Annotated[str, Field(validation_alias=AliasPath("protocol", "metrics"))]
    commit: str | None = Field(None, validation_alias=AliasPath("git", "commit"))
    changed: bool = Field(False, validation_alias=AliasPath("git", "changed"))
    training: dict[str, float | None] | None = None


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
        value = (source.training or {}).get(key)
        if value is not None:
            rows[name] = (rows["method"] == METHOD).map({True: value / unit})
    git = source.commit and source.commit[:9] + " with changes" * source.changed
    about = {"seed": seed, "source": str(path), "run": source.config_hash, "git": git}
    about |= {name: getattr(source, name) for name in ("data", "split", "protocol")}
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


def _find_runs(folders: Sequence[Path]) -> list[Path]:
    """The ``metrics.json`` of each run, or the ``config.yaml`` of one without results: by folder, then in
    the order of a sweep's command."""
    commands = cache(runs_in_order)

    def place(run: Path) -> tuple:
        names = commands(run.parent)
        return run.parent, names.index(run.name) if run.name in names else len(names), run

    files: list[Path] = []
    for folder in folders:
        if not folder.is_dir():
            found = "a file" if folder.is_file() else "none"
            raise FileNotFoundError(f"{folder}: expected a directory of runs; found {found}")
        runs = {path.parent for name in ("metrics.json", "config.yaml") for path in folder.rglob(name)}
        for run in sorted((run for run in runs if run.name != ".hydra"), key=place):
            measured = run / "metrics.json"
            files.append(measured if measured.exists() else run / "config.yaml")
    return files


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
    results: dict[str, pd.DataFrame] = {}
    models: dict[str, Mapping[str, Any]] = {}
    begun: dict[str, Mapping[str, Any]] = {}
    known: set[str] = set()
    for path in _find_runs(folders):
        if path.name == "metrics.json":
            results[str(path)], config = _read_run(path)
            known |= flatten(config).keys()
            if METHOD in set(results[str(path)]["method"]):
                models[str(path)] = config
        elif config := _read_training(path):
            begun[str(path)] = config
    if not results:
        names = ", ".join(map(str, folders))
        found = f"{len(begun)} runs without one" if begun else "none"
        raise InputError(f"{names}: expected runs with a metrics.json below it; found {found}")
    for key in by:
        require(any(is_below(k, [key]) for k in known), "by", "keys of the runs' configurations", key)
    configs = {**models, **begun}
    views = {} if TRAINING_COUNTS in by else find_views_of_columns(configs)
    for path in views:  # one row, whatever the number of views in training
        configs[path] = {**configs[path], "views": {**configs[path]["views"], "training_counts": "as many"}}
    by = list(dict.fromkeys([*by, *find_keys_of_rows(configs.values())]))
    variants = {path: model_variant(config, path, by) for path, config in configs.items()}
    frames = []
    for path, rows in results.items():
        if path in views:
            rows = rows[(rows["method"] != METHOD) | (rows["views"] == views[path])]
        variant = [variants[path] if name == METHOD else Variant("baseline", name) for name in rows["method"]]
        trained_views = float(views.get(path, "nan"))
        frames.append(rows.drop(columns="method").assign(variant=variant, trained_views=trained_views))
    planned = []
    for path, config in begun.items():
        counts = views.get(path, lookup(config, "evaluation.views"))
        counts = (counts,) if isinstance(counts, int) else tuple(counts or ())
        data = str(lookup(config, "data.name"))
        planned.append(Planned(variants[path], data, counts, config.get("seed", 0)))
    return Sweep(pd.concat(frames, ignore_index=True), planned, models)


_Text = Annotated[str, Field(min_length=1)]
_Count = Annotated[int, Field(ge=1)]


class _Row(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")
    data: _Text
    split: _Text
    targets: _Text
    protocol: _Text
    views: _Count
    seed: int = 0
    subject: _Text | None = None
    subjects: _Count | None = None
    metrics: Annotated[dict[str, FiniteFloat], Field(min_length=1)]


class _Others(BaseModel):
    """A results file of another method, in the format that ``docs/tables.md`` describes."""

    model_config = ConfigDict(strict=True, extra="forbid")
    format: Literal["ghgs_lit.others"]
    format_version: Literal[1]
    method: _Text
    source: _Text
    rows: Annotated[list[_Row], Field(min_length=1)]


def read_others(path: Path) -> pd.DataFrame:
    """Read the results file of another method.

    Args:
        path: JSON file in the format of ``docs/tables.md``.

    Returns:
        Rows as in :class:`Sweep`. ``origin`` is the file's ``source``. Means have no ``subject``, and
        optionally a ``count`` of subjects.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: It does not have the format; the message names the key.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected another method's results; found no such file")
    others = validate(_Others, read_json(path), path.name)
    rows = pd.DataFrame([row.model_dump() for row in others.rows])
    cell = [*SETTING, "views", "seed"]
    repeated = rows.duplicated([*cell, "subject"])
    if repeated.any():
        at = f"{path.name}.rows[{repeated.idxmax()}]"
        raise InputError(f"{at}: expected each subject once a setting; found one again")
    means = rows["subject"].isna()
    if (means.groupby([rows[key] for key in cell]).nunique() > 1).any() or rows[~means]["subjects"].any():
        raise InputError(f"{path.name}: expected subjects or one mean for each setting; found both")
    metrics = pd.DataFrame(list(rows.pop("metrics")), dtype=float)
    rows = rows.rename(columns={"subjects": "count"}).astype({"count": float})
    variant = Variant("other", others.method)
    return rows.assign(variant=variant, source=str(path), run=None, origin=others.source).join(metrics)
