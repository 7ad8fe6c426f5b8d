"""Runs below folders as one frame: row of the table, setting, and metrics of each subject.

A run is identified by its configuration, never by the name of its directory.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from pydantic import AliasPath, BaseModel, ConfigDict, Field

from ghgs_lit.config import conf_dir
from ghgs_lit.config.keys import ablation_of, flatten, is_below, is_custom_ablation, lookup, switches_of
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import read_yaml
from ghgs_lit.runs.results import METHOD, read_results, validate
from ghgs_lit.runs.run import runs_in_order

SETTING = ["data", "split", "targets", "protocol"]
"""Columns whose values all numbers in a column of a table share."""
TRAINING = {"steps": ("steps", 1), "seconds": ("seconds", 1), "peak_gb": ("peak_bytes", 1e9)}
"""Metrics of the training, which are not per subject: key in the provenance, and divisor to the
printed unit."""
TRAINING_COUNTS = "views.training_counts"
OF_TRAINING_TARGETS = ("training_views", "per_step")
"""Keys of ``targets`` that affect training."""
#: Keys that identify an encoder of conf/encoder; models change its other keys.
_ENCODER_KEYS = ("width", "heads", "depth", "layers", "vit")


@dataclass(frozen=True)
class Variant:
    """Identity of a row of a table.

    Attributes:
        kind: ``model`` (ours), ``baseline`` or ``reported`` (by the paper).
        name: Name of the method.
        model: Name of the model, with its differences from the shipped one; empty for other methods.
        encoder: Name of its encoder; empty for other methods.
        ablation: The chosen option; empty for other methods.
        switches: Whether its 3D unprojection and semantic consistency are on.
        extra: Further configuration keys that distinguish rows, such as ``optimizer.lr=0.1``.
        has_semantics: Whether the semantic features were trained (published weights or `ghgs
            pretext`); unknown before training starts, so it does not distinguish rows.
    """

    kind: str
    name: str
    model: str = ""
    encoder: str = ""
    ablation: str = ""
    switches: tuple[bool, bool] | None = None
    extra: tuple[str, ...] = ()
    has_semantics: bool = field(default=True, compare=False)

    @property
    def is_own(self) -> bool:
        """Whether this is a row of a user-defined ablation."""
        return bool(self.ablation) and is_custom_ablation(self.ablation)

    @property
    def trained(self) -> str:
        """Identity of the model without its ablation."""
        return " ".join((self.model, self.encoder, *self.extra))


@dataclass(frozen=True)
class Sweep:
    """All runs below the directories of a sweep.

    Attributes:
        rows: One for each run, method, number of views, target protocol and subject, with
            ``variant``, ``SETTING``, ``views``, ``seed``, ``source`` (the file), ``run`` (the
            configuration's hash), ``git`` (in words), ``subject``, and the metrics, averaged over the
            subject's targets; and ``trained_views``, the number of views in training of models that
            share a row and were each trained with a different one. Of a training without results: one
            row for each number of views, without subject and metrics.
        configs: Configuration of our model by ``source``.
    """

    rows: pd.DataFrame
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
    """Rows of a ``metrics.json``, and the configuration of its model as trained and measured."""
    content = read_results(path)
    source = validate(_Provenance, content["provenance"], f"{path}: provenance")
    trained = (source.checkpoint_config or source.config) | (source.changed_model or {})
    of_evaluation = ("checkpoint", "refine", "refine_cameras", "data", "metrics")
    config = trained | {key: source.config[key] for key in of_evaluation if key in source.config}
    measured = source.config.get("targets")
    if isinstance(measured, Mapping) and isinstance(trained.get("targets"), Mapping):
        of_training = {key: trained["targets"].get(key) for key in OF_TRAINING_TARGETS}
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


def _read_training(path: Path) -> tuple[pd.DataFrame, dict[str, Any]] | None:
    """Rows without results of a training's ``config.yaml``, and its configuration; None: it belongs to
    another command or is incomplete."""
    try:
        config = read_yaml(path)
    except InputError:
        return None
    needed = ("trainer", "data", "recalibration")
    if not isinstance(config, Mapping) or not all(key in config for key in needed):
        return None
    seed = config.get("seed", 0)
    require(isinstance(seed, int), f"{path}: seed", "a whole number", seed)
    rows = pd.DataFrame({"views": lookup(config, "evaluation.views") or []})
    data = str(lookup(config, "data.name"))
    return rows.assign(method=METHOD, seed=seed, source=str(path), data=data, subject=None), config


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
        by: Configuration keys that distinguish rows beyond model, encoder and ablation.

    Raises:
        FileNotFoundError: A folder is missing.
        InputError: There is no finished run, a ``metrics.json`` is damaged, or no run has a key of
            ``by``.
    """
    frames: dict[str, pd.DataFrame] = {}
    configs: dict[str, Mapping[str, Any]] = {}
    for path in _find_runs(folders):
        is_measured = path.name == "metrics.json"
        run = _read_run(path) if is_measured else _read_training(path)
        if run is not None:
            frames[str(path)], configs[str(path)] = run
    if not any(path.endswith("metrics.json") for path in frames):
        names = ", ".join(map(str, folders))
        found = f"{len(frames)} runs without one" if frames else "none"
        raise InputError(f"{names}: expected runs with a metrics.json below it; found {found}")
    known = set().union(*map(flatten, configs.values()))
    for key in by:
        require(any(is_below(k, [key]) for k in known), "by", "keys of the runs' configurations", key)
    configs = {path: config for path, config in configs.items() if METHOD in set(frames[path]["method"])}
    views = {} if TRAINING_COUNTS in by else find_views_of_columns(configs)
    for path, rows in frames.items():
        variants = {name: Variant("baseline", name) for name in rows["method"]}
        if path in configs:
            variants[METHOD] = model_variant(configs[path], path, by)
        if path in views:
            rows = rows[(rows["method"] != METHOD) | (rows["views"] == views[path])]
        trained_views = float(views.get(path, "nan"))
        variant = [variants[name] for name in rows["method"]]
        frames[path] = rows.drop(columns="method").assign(variant=variant, trained_views=trained_views)
    return Sweep(pd.concat(frames.values(), ignore_index=True), configs)


def find_views_of_columns(configs: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """Number of views in training, by file, of models that fill one column each.

    These are models on the same data that were each trained with a single number of views, if these
    numbers differ.
    """
    counts: dict[str, dict[str, int]] = {}
    for path, config in configs.items():
        trained = lookup(config, TRAINING_COUNTS)
        if isinstance(trained, list | tuple) and len(trained) == 1:
            counts.setdefault(str(lookup(config, "data.name")), {})[path] = trained[0]
    views: dict[str, int] = {}
    for of_data in counts.values():
        if len(set(of_data.values())) > 1:
            views |= of_data
    return views


@cache
def _read_shipped(group: str) -> dict[str, dict]:
    return {path.stem: read_yaml(path) for path in sorted((conf_dir() / group).glob("*.yaml"))}


def encoder_name(config: Mapping[str, Any]) -> str:
    """Name of the encoder in a configuration.

    Args:
        config: Resolved configuration of a training.

    Returns:
        The option of conf/encoder with these sizes, or ``unnamed``, followed by ``, semantic branch``
        if it has one.
    """
    branch = ", semantic branch" * (lookup(config, "encoder.semantic") is not None)
    values = flatten({key: lookup(config, f"encoder.{key}") for key in _ENCODER_KEYS})
    for name, shipped in _read_shipped("encoder").items():
        # A file overrides single keys of nested mappings.
        if flatten({key: shipped.get(key) for key in _ENCODER_KEYS}).items() <= values.items():
            return name + branch
    return "unnamed" + branch


def model_variant(config: Mapping[str, Any], source: str, by: Sequence[str] = ()) -> Variant:
    """The table row of a model.

    Args:
        config: Configuration of the model as trained and measured.
        source: File of the configuration, for messages.
        by: Keys that distinguish rows beyond model, encoder and ablation.

    Raises:
        InputError: The configuration has no recalibration, whose parts the ablation switches.
    """
    recalibration = config.get("recalibration")
    require(isinstance(recalibration, Mapping), f"{source}: recalibration", "a mapping", recalibration)
    # A user-defined option of conf/model can have the name of the one that it is based on.
    model = lookup(config, "chosen.model")
    if model is None or model in _read_shipped("model"):
        model = str(lookup(config, "model.name") or "unnamed")
    compat = lookup(config, "compat.name")
    model += f", compat {compat}" * (compat not in (None, "none"))
    return Variant(
        "model",
        "ours",
        model,
        encoder_name(config),
        ablation_of(config),
        switches_of(config),
        tuple(f"{key}={lookup(config, key)}" for key in by),
        # Without such weights the encoder was trained by the rendering loss only.
        has_semantics=bool(lookup(config, "encoder.weights")),
    )


ABSENT = "absent"
"""Text for a key that a configuration does not have."""


def find_differences(configs: Sequence[Mapping[str, Any]], expected: Iterable[str]) -> dict[str, list[str]]:
    """Find the dotted keys in which configurations differ.

    Args:
        configs: Configurations of several runs.
        expected: Keys that may differ, with those below them.

    Returns:
        Different values of each key as text, ``ABSENT`` where a configuration does not have it.
    """
    flat = [flatten(config) for config in configs]
    texts = {}
    for key in dict.fromkeys(key for values in flat for key in values):
        values = list(dict.fromkeys(str(values.get(key, ABSENT)) for values in flat))
        if len(values) > 1 and not is_below(key, expected):
            texts[key] = values
    return texts


def describe(keys: Mapping[str, Sequence[str]]) -> str:
    """The first keys and values of :func:`find_differences`, such as ``optimizer.lr (0.001, 0.0001)``."""
    shown = [f"`{key}` ({', '.join(values[:4])})" for key, values in list(keys.items())[:6]]
    return ", ".join(shown) + (f" and {len(keys) - 6} more" if len(keys) > 6 else "")
