"""Runs as one frame: row of the table, setting, and metrics of each subject.

A run is identified by its configuration, never by the name of its directory.
"""

import itertools
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
from pydantic import BaseModel, ConfigDict, Field

from ghgs_lit.config import conf_dir
from ghgs_lit.config.keys import (
    EXPECTED_TO_DIFFER,
    OF_A_PLACE,
    OF_A_RUN,
    OF_TARGETS,
    OF_TRAINING,
    ablation_of,
    flatten,
    is_below,
    is_own_ablation,
    lookup,
    switches_of,
)
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import read_yaml
from ghgs_lit.runs.results import METHOD, config_hash, read_results, validated
from ghgs_lit.runs.run import runs_in_order

SETTING = ["data", "split", "targets", "protocol"]
"""What numbers in one column must have in common."""
TRAINING = {"steps": ("steps", 1), "seconds": ("seconds", 1), "peak_gb": ("peak_bytes", 1e9)}
"""Metrics of the training, which no subject has, with their keys in the provenance and units."""
ABSENT = "absent"
"""Text of a value that a configuration does not have."""
TRAINING_COUNTS = "views.training_counts"
#: Titles of keys that distinguish rows without being named by the user.
_KEY_TITLES = {
    TRAINING_COUNTS: "trained with {} views",
    "views.training": "input views in training: {}",
    "targets.training_views": "target views in training: {}",
    "targets.per_step": "targets a step: {}",
    "targets.kind": "targets: {}",
    "targets.view": "target view {}",
    "targets.positions": "positions of targets: {}",
    "targets.per_subject": "targets a subject: {}",
}
#: Keys that identify an encoder of conf/encoder; models change its other keys.
_ENCODER_KEYS = ("width", "heads", "depth", "layers", "vit")


@dataclass(frozen=True)
class Variant:
    """Identity of a row of a table.

    Attributes:
        kind: ``model`` (ours), ``baseline``, ``other`` (another method) or ``reported`` (by the paper).
        name: Of the method.
        model: Name of the model, with what sets it apart from the shipped one; empty for other methods.
        encoder: Name of its encoder; empty for other methods.
        ablation: The chosen option; empty for other methods.
        switches: Whether its 3D unprojection and semantic consistency are on.
        has_semantics: Whether the semantic features were trained (published weights or `ghgs pretext`);
            unknown before training starts, so it does not distinguish rows.
        extra: Further configuration keys and values that do.
    """

    kind: str
    name: str
    model: str = ""
    encoder: str = ""
    ablation: str = ""
    switches: tuple[bool, bool] | None = None
    has_semantics: bool = field(default=True, compare=False)
    extra: tuple[tuple[str, str], ...] = ()

    @property
    def is_own(self) -> bool:
        """Whether this is a row of a user's own ablation."""
        return bool(self.ablation) and is_own_ablation(self.ablation)

    @property
    def titles(self) -> list[str]:
        """What distinguishes the row beyond model, encoder and ablation, in words."""
        return [_KEY_TITLES.get(key, key + "={}").format(value.strip("[]")) for key, value in self.extra]

    @property
    def trained(self) -> tuple:
        """Identity of the model without its ablation."""
        return (self.model, self.encoder, self.extra)


class Planned(NamedTuple):
    """A training run without results yet: its row, data set, numbers of input views (None: unknown), seed."""

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

    rows: pd.DataFrame
    planned: list[Planned]
    configs: dict[str, Mapping[str, Any]]
    order: list[Variant]


@cache
def _shipped(group: str) -> dict[str, dict]:
    return {path.stem: read_yaml(path) for path in (conf_dir() / group).glob("*.yaml")}


def encoder_name(config: Mapping[str, Any]) -> str:
    """Name of the encoder in a configuration.

    Args:
        config: Resolved configuration of a training.

    Returns:
        The option of conf/encoder with its sizes, or ``unnamed``, and whether it has a semantic branch.
    """
    encoder = config.get("encoder")
    encoder = encoder if isinstance(encoder, Mapping) else {}
    branch = ", semantic branch" * (encoder.get("semantic") is not None)
    values = flatten({key: encoder.get(key) for key in _ENCODER_KEYS})
    for name, shipped in sorted(_shipped("encoder").items()):
        # A file lists of a nested mapping only what differs from the file below it.
        if flatten({key: shipped.get(key) for key in _ENCODER_KEYS}).items() <= values.items():
            return name + branch
    return "unnamed" + branch


def ablation_sets(config: Mapping[str, Any]) -> dict[str, Any]:
    """Dotted keys with the values that the chosen ablation of a training sets; empty if unknown."""
    sets = lookup(config, "chosen.sets")
    return dict(sets) if isinstance(sets, Mapping) else {}


def model_variant(config: Mapping[str, Any], source: str, by: Sequence[str] = ()) -> Variant:
    """The row that a model belongs to.

    Args:
        config: Configuration of the model as trained and measured.
        source: File of the configuration, for messages.
        by: Keys that distinguish rows beyond model, encoder and ablation.

    Raises:
        InputError: The configuration has no recalibration, of which the ablation takes parts away.
    """
    recalibration = config.get("recalibration")
    require(isinstance(recalibration, Mapping), f"{source}: recalibration", "a mapping", recalibration)
    compat = lookup(config, "compat.name")
    ablation = ablation_of(config)
    encoder = encoder_name(config)
    # A user's option of conf/model may have kept the name of the one that it changes.
    model = lookup(config, "chosen.model")
    if model is None or model in _shipped("model"):
        model = str(lookup(config, "model.name") or "unnamed")
    model += f", compat {compat}" * (compat not in (None, "none"))
    # What a user's ablation changes is a row of the model's table, not another model. The paper's
    # ablations find neighbours in 3D or on the image plane.
    if is_own_ablation(ablation):
        if any(is_below(key, ["encoder"]) for key in ablation_sets(config)):
            encoder = encoder.replace("unnamed", str(lookup(config, "chosen.encoder")))
    elif recalibration.get("neighborhood") == "feature":
        model += ", neighbours by feature"
    extra = tuple((key, str(lookup(config, key))) for key in by)
    # Without such weights the encoder has learned from the rendering loss only.
    has_semantics = bool(lookup(config, "encoder.weights"))
    return Variant("model", "ours", model, encoder, ablation, switches_of(config), has_semantics, extra)


def _views_of_columns(configs: Mapping[str, Mapping[str, Any]]) -> dict[str, int]:
    """Numbers of views by file of models that fill one column each: models on the same data that were
    trained with one number of views each, and not all with the same one."""
    counts: dict[str, dict[str, int]] = {}
    for path, config in configs.items():
        trained = lookup(config, TRAINING_COUNTS)
        if isinstance(trained, list | tuple) and len(trained) == 1:
            counts.setdefault(str(lookup(config, "data.name")), {})[path] = trained[0]
    several = [of_data for of_data in counts.values() if len(set(of_data.values())) > 1]
    return dict(itertools.chain.from_iterable(map(dict.items, several)))


def _keys_of_rows(configs: Iterable[Mapping[str, Any]]) -> list[str]:
    """Keys of views and targets in which runs that could share a row differ: runs on the same data
    by how they were trained, those with a protocol of the same name by its targets."""
    values: dict[tuple[str, ...], set[str]] = {}
    for config in configs:
        data = str(lookup(config, "data.name"))
        protocol = str(lookup(config, "targets.name"))
        places = [(key, data) for key in OF_TRAINING] + [(key, data, protocol) for key in OF_TARGETS]
        for place in places:
            values.setdefault(place, set()).add(str(lookup(config, place[0])))
    return [key for (key, *_), different in values.items() if len(different) > 1]


def _variants_of(configs: Mapping[str, Mapping[str, Any]], by: Sequence[str]) -> dict[str, Variant]:
    """Variants by file. Models of one configuration have one row, whatever their ablations are called:
    by the paper's name if one has it."""
    variants = {path: model_variant(config, path, by) for path, config in configs.items()}
    keys = {path: config_hash(config, (*OF_A_RUN, *OF_A_PLACE)) for path, config in configs.items()}
    names: dict[str, str] = {}
    for path, variant in variants.items():
        if keys[path] not in names or not variant.is_own:
            names[keys[path]] = variant.ablation
    return {path: replace(variant, ablation=names[keys[path]]) for path, variant in variants.items()}


def differing(
    configs: Sequence[Mapping[str, Any]], expected: Iterable[str] = EXPECTED_TO_DIFFER
) -> dict[str, list[str]]:
    """Dotted keys in which configurations differ, with their values as text, ``ABSENT`` among them.

    Args:
        configs: Of several runs.
        expected: Keys that may differ, with those below them.
    """
    flat = [flatten(config) for config in configs]
    texts = {}
    for key in dict.fromkeys(itertools.chain.from_iterable(flat)):
        values = list(dict.fromkeys(str(values.get(key, ABSENT)) for values in flat))
        if len(values) > 1 and not is_below(key, expected):
            texts[key] = values
    return texts


def describe(keys: Mapping[str, Sequence[str]]) -> str:
    """The first keys and values of :func:`differing`, such as ``optimizer.lr (0.001, 0.0001)``."""
    shown = [f"`{key}` ({', '.join(values[:4])})" for key, values in list(keys.items())[:6]]
    return ", ".join(shown) + (f" and {len(keys) - 6} more" if len(keys) > 6 else "")


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
    """The ``config.yaml`` of a training run; None: it is another command's or incomplete."""
    try:
        config = read_yaml(path)
    except InputError:
        return None
    needed = ("trainer", "data", "recalibration")
    if not isinstance(config, Mapping) or not all(key in config for key in needed):
        return None
    require(isinstance(config.get("seed", 0), int), f"{path}: seed", "a whole number", config.get("seed"))
    return config


def natural(text: str) -> list[str | float]:
    """Key that sorts texts by the numbers in them, so that ``k=10`` comes after ``k=9``."""
    parts = re.split(r"(\d+(?:\.\d+)?(?:e[-+]?\d+)?)", text)
    return [float(part) if i % 2 else part for i, part in enumerate(parts)]


def _in_order(paths: Iterable[str], folders: Sequence[Path], variants: Mapping[str, Variant]) -> list[str]:
    """Files of runs in the order of folders, then of the sweep's command, then of their rows' names."""
    commands = {sweep: runs_in_order(sweep) for sweep in {Path(path).parent.parent for path in paths}}

    def place(path: str) -> tuple:
        run = Path(path).parent
        folder = [run.is_relative_to(folder) for folder in folders].index(True)
        names = commands[run.parent]
        number = names.index(run.name) if run.name in names else len(names)
        return folder, natural(str(run.parent)), number, natural(str(variants.get(path))), natural(path)

    return sorted(paths, key=place)


def _files_below(folders: Sequence[Path], name: str) -> list[Path]:
    paths = itertools.chain.from_iterable(sorted(folder.rglob(name)) for folder in folders)
    return [path for path in paths if path.parent.name != ".hydra"]


def read_sweep(folders: Sequence[Path], by: Sequence[str] = ()) -> Sweep:
    """All runs below folders, finished or not.

    Args:
        folders: Directories of sweeps or runs.
        by: Configuration keys that distinguish rows beyond model, encoder, ablation and the views
            and targets of the training.

    Raises:
        FileNotFoundError: A folder is missing.
        InputError: There is no finished run, a ``metrics.json`` is damaged,
            or no run has a key of ``by``.
    """
    for folder in folders:
        if not folder.is_dir():
            found = "a file" if folder.is_file() else "none"
            raise FileNotFoundError(f"{folder}: expected a directory of runs; found {found}")
    runs = {str(path): _read_run(path) for path in _files_below(folders, "metrics.json")}
    trainings = {str(path): _read_training(path) for path in _files_below(folders, "config.yaml")}
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
    views = {} if TRAINING_COUNTS in by else _views_of_columns(configs)
    for path in views:  # which differ no more by the number of views in training
        configs[path] = {**configs[path], "views": {**configs[path]["views"], "training_counts": "as many"}}
    variants = _variants_of(configs, list(dict.fromkeys([*by, *_keys_of_rows(configs.values())])))
    frames = []
    planned = []
    paths = _in_order({**runs, **trainings}, folders, variants)
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
