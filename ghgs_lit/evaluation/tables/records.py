"""Measurements of runs, and of other methods, as DataFrames: method, setting, values of each subject.

A run is identified by its configuration, never by the name of its directory.
"""

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from ghgs_lit.config.keys import flatten, is_below, lookup
from ghgs_lit.errors import InputError, require
from ghgs_lit.evaluation.tables.variants import (
    TRAINING_COUNTS,
    Variant,
    keys_of_rows,
    variants_of,
    views_of_columns,
    with_views_of_column,
)
from ghgs_lit.parsing import read_json, read_yaml
from ghgs_lit.runs.results import METHOD, read_results, validated
from ghgs_lit.runs.run import runs_in_order

SETTING = ["data", "split", "targets", "protocol"]
"""What numbers in one column must have in common."""
TRAINING = {"steps": ("steps", 1), "seconds": ("seconds", 1), "peak_gb": ("peak_bytes", 1e9)}
"""Metrics of the training, which no subject has, with their keys in the provenance and units."""
_ROW = ["method", "views", "targets", "subject"]


@dataclass(frozen=True)
class Planned:
    """A training run without results yet, with the cells that it will fill.

    Attributes:
        variant: Row of its cells.
        data: Name of its data set.
        views: Numbers of input views of its columns; None: not known.
        seed: Of the run.
    """

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
            configuration's hash), ``git`` (in words), ``subject``, and the metrics, averaged over
            the subject's targets; and ``trained_views``, the number of views of models that share a
            row because each was trained with another one.
        planned: Training runs without results.
        configs: Configuration of our model by ``source``.
        order: Variants of our models in the order of rows.
    """

    rows: pd.DataFrame = field(default_factory=pd.DataFrame)
    planned: list[Planned] = field(default_factory=list)
    configs: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    order: list[Variant] = field(default_factory=list)


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
    # Of `ghgs evaluate`: how the model was trained, and what the command line changed in it.
    checkpoint_config: dict[str, Any] | None = None
    changed_model: dict[str, Any] | None = Field(None, alias="model_config")
    seed: int | None = None
    data: _Data
    protocol: _Protocol
    git: _Git | None = None
    training: _Training | None = None


def _read_run(path: Path) -> tuple[pd.DataFrame, dict[str, Any]]:
    """Rows of a ``metrics.json``, without ``variant``, and the configuration of its model as
    trained and measured."""
    content = read_results(path)
    source = validated(_Provenance, content["provenance"], f"{path}: provenance")
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
    rows = rows.rename(columns={"seconds": "prediction_seconds"}).set_index(_ROW).astype(float)
    rows = rows.groupby(level=_ROW, sort=False).mean().dropna(axis="columns", how="all").reset_index()
    for name, (key, unit) in TRAINING.items():
        value = getattr(source.training, key, None)
        if value is not None:
            rows[name] = (rows["method"] == METHOD).map({True: value / unit})
    git = source.git and source.git.commit[:9] + " with changes" * source.git.changed
    about = {"seed": seed, "source": str(path), "run": source.config_hash, "git": git}
    about |= {"data": source.data.name, "split": source.data.split, "protocol": source.protocol.metrics}
    return rows.assign(**about), config


def _with_variants(rows: pd.DataFrame, model: Variant | None, views: int | None) -> pd.DataFrame:
    """Rows of a run whose ``method`` is replaced by their ``variant``.

    Args:
        rows: Of one run.
        model: Variant of the model's rows; None: there are none.
        views: Number of views, with which alone the model is shown; None: with all.
    """
    if views is not None:
        rows = rows[(rows["method"] != METHOD) | (rows["views"] == views)]
    variants = [model if name == METHOD else Variant("baseline", name) for name in rows["method"]]
    trained_views = float("nan") if views is None else float(views)
    return rows.drop(columns="method").assign(variant=variants, trained_views=trained_views)


def _training_config(path: Path) -> dict[str, Any] | None:
    """The configuration of a training run in a ``config.yaml``;
    None: it is another verb's or incomplete."""
    try:
        config = read_yaml(path)
    except InputError:
        return None
    needed = ("trainer", "data", "recalibration")
    if not isinstance(config, Mapping) or not all(key in config for key in needed):
        return None
    require(isinstance(config.get("seed", 0), int), f"{path}: seed", "a whole number", config.get("seed"))
    return config


def _planned(config: Mapping[str, Any], variant: Variant, views: int | None) -> Planned:
    measured = lookup(config, "evaluation.views") if views is None else views
    columns = (measured,) if isinstance(measured, int) else measured and tuple(measured)
    return Planned(variant, str(lookup(config, "data.name")), columns, config.get("seed", 0))


def _in_order(paths: Iterable[str], folders: Sequence[Path], variants: Mapping[str, Variant]) -> list[str]:
    """Files of runs in the order of folders, then of the sweep's command, then of their rows' names."""
    planned = {sweep: runs_in_order(sweep) for sweep in {Path(path).parent.parent for path in paths}}

    def place(path: str) -> tuple:
        run = Path(path).parent
        folder = [run.is_relative_to(folder) for folder in folders].index(True)
        names = planned[run.parent]
        number = names.index(run.name) if run.name in names else len(names)
        return folder, natural(str(run.parent)), number, natural(str(variants.get(path))), natural(path)

    return sorted(paths, key=place)


def natural(text: str) -> list[str | float]:
    """Key that sorts texts by the numbers in them.

    Args:
        text: Such as ``k=10``, which comes after ``k=9``.

    Returns:
        Parts of the text, every other one a number.
    """
    parts = re.split(r"(\d+(?:\.\d+)?(?:e[-+]?\d+)?)", text)
    return [float(part) if i % 2 else part for i, part in enumerate(parts)]


def files_below(folders: Sequence[Path], name: str) -> list[Path]:
    """Files of a name below folders, except in ``.hydra``.

    Args:
        folders: Searched one after another.
        name: Of the files.

    Returns:
        Paths in the order of folders and names.

    Raises:
        FileNotFoundError: A folder is missing.
    """
    for folder in folders:
        if not folder.is_dir():
            found = "a file" if folder.is_file() else "none"
            raise FileNotFoundError(f"{folder}: expected a directory of runs; found {found}")
    paths = itertools.chain.from_iterable(sorted(folder.rglob(name)) for folder in folders)
    return [path for path in paths if path.parent.name != ".hydra"]


def read_sweep(folders: Sequence[Path], by: Sequence[str] = ()) -> Sweep:
    """All runs below folders, finished or not.

    Args:
        folders: Directories of sweeps or runs.
        by: Configuration keys that distinguish rows beside model, encoder, ablation and the views
            and targets of the training.

    Returns:
        Measurements, planned runs and configurations.

    Raises:
        FileNotFoundError: A folder is missing.
        InputError: There is no finished run, a ``metrics.json`` is damaged,
            or no run has a key of ``by``.
    """
    runs = {str(path): _read_run(path) for path in files_below(folders, "metrics.json")}
    files = {str(path): _training_config(path) for path in files_below(folders, "config.yaml")}
    trainings = {path: config for path, config in files.items() if config is not None}
    if not runs:
        names = ", ".join(map(str, folders))
        begun = f"{len(trainings)} runs without one" if trainings else "none"
        raise InputError(f"{names}: expected runs with a metrics.json below it; found {begun}")
    models = {source: config for source, (rows, config) in runs.items() if METHOD in set(rows["method"])}
    known = set().union(*(flatten(config) for _, config in runs.values()))
    for key in by:
        require(any(is_below(k, [key]) for k in known), "by", "keys of the runs' configurations", key)
    configs = {**models, **trainings}
    views = {} if TRAINING_COUNTS in by else views_of_columns(configs)
    configs |= {path: with_views_of_column(configs[path]) for path in views}
    by = list(dict.fromkeys([*by, *keys_of_rows(configs.values())]))
    variants = variants_of(configs, by)
    paths = _in_order({**runs, **trainings}, folders, variants)
    rows = [_with_variants(runs[p][0], variants.get(p), views.get(p)) for p in paths if p in runs]
    unfinished = [p for p in paths if p in trainings and str(Path(p).with_name("metrics.json")) not in runs]
    planned = [_planned(trainings[p], variants[p], views.get(p)) for p in unfinished]
    order = list(dict.fromkeys(variants[path] for path in paths if path in variants))
    return Sweep(pd.concat(rows).reset_index(drop=True), planned, models, order)


def person_of(subject: str, unit: re.Pattern[str] | None) -> str:
    """Person of a subject.

    Args:
        subject: Name of a person, or of one frame of a person.
        unit: Regular expression whose first group is the person; None: subjects are people.

    Returns:
        The first group if the expression matches, else the subject.
    """
    match = unit.fullmatch(subject) if unit else None
    return match[1] if match else subject


_Text = Annotated[str, Field(min_length=1)]
_Count = Annotated[int, Field(ge=1)]


class _Exact(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid")


class _Row(_Exact):
    data: _Text
    split: _Text
    targets: _Text
    protocol: _Text
    views: _Count
    seed: int = 0
    subject: _Text | None = None
    subjects: _Count | None = None
    metrics: Annotated[dict[str, FiniteFloat], Field(min_length=1)]


class _Others(_Exact):
    """Another method's file, which ``docs/tables.md`` describes."""

    format: Literal["ghgs_lit.others"]
    format_version: Literal[1]
    method: _Text
    source: _Text
    rows: Annotated[list[_Row], Field(min_length=1)]


def read_others(path: Path) -> pd.DataFrame:
    """Rows of another method's results file,
    like those of :class:`Sweep`.

    Args:
        path: JSON file of the format above.

    Returns:
        Rows; ``said`` is the file's ``source``; means have no ``subject`` and may have a
        ``count`` of subjects.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: It does not have the format; the message names the key.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: expected another method's results; found no such file")
    others = validated(_Others, read_json(path), path.name)
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
    return rows.assign(variant=variant, source=str(path), run=None, said=others.source).join(metrics)
