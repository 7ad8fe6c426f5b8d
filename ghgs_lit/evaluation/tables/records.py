"""What runs measured, as records: the method, the setting, the values of each subject.

A run is identified by its configuration, never by the name of its directory.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from ghgs_lit.config import conf_dir
from ghgs_lit.config.ablation import ABLATIONS, switches_of
from ghgs_lit.config.keys import lookup
from ghgs_lit.errors import InputError
from ghgs_lit.runs.results import METHOD, by_protocol, entry, mean, metric_names, read_results

#: The time of a prediction in the rows of results: in tables ``seconds`` are those of the training.
_PREDICTION = {"seconds": "prediction_seconds"}

# Keys that identify an encoder of conf/encoder; models change its other keys.
_ENCODER_KEYS = ("patch_size", "width", "heads", "depth", "layers", "vit")


@dataclass(frozen=True)
class Variant:
    """What a row of a table shows.

    Args:
        kind: ``model`` (ours), ``baseline``, ``other`` (another method) or ``reported`` (by the paper).
        name: name of the method.
        model, encoder: options of our model.
        switches: whether 3D unprojection and semantic consistency are on.
        has_semantics: whether the semantic features have learned parts: from published weights or in `ghgs
            pretext`. It is not known before training starts, so rows are not told apart by it.
        extra: further configuration keys and their values that tell rows apart.
    """

    kind: str
    name: str
    model: str = ""
    encoder: str = ""
    switches: tuple[bool, bool] | None = None
    has_semantics: bool = field(default=True, compare=False)
    extra: tuple[tuple[str, str], ...] = ()

    @property
    def ablation(self) -> str:
        """The ablation's name by its switches; empty without switches."""
        return ABLATIONS[self.switches] if self.switches else ""

    @property
    def trained(self) -> tuple:
        """What was trained, without its ablation."""
        return (self.model, self.encoder, self.extra)


@dataclass(frozen=True)
class Setting:
    """What numbers in one column must have in common."""

    data: str
    split: str
    targets: str
    protocol: str


@dataclass(frozen=True)
class Record:
    """One run of one method with one number of input views.

    Args:
        variant: the row that it belongs to.
        setting: data, split, targets and metrics.
        views: number of input views.
        seed: seed of the training.
        means: means over subjects by metric.
        source: the file that it was read from.
        count: number of subjects, where it is known.
        subjects: values of each subject (averaged over its targets) by metric; empty if only means are known.
        config: the configuration of our model.
        about: ``hash`` and ``git`` of our runs; ``source`` of other methods, in words.
    """

    variant: Variant
    setting: Setting
    views: int
    seed: int
    means: Mapping[str, float]
    source: str
    count: int | None = None
    subjects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    config: Mapping[str, Any] | None = None
    about: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Planned:
    """A training run, finished or not: which cells it fills, and whether it is done."""

    variant: Variant
    data: str
    seed: int
    done: bool


@dataclass
class Sweep:
    """Everything below the directories of a sweep."""

    records: list[Record] = field(default_factory=list)
    planned: list[Planned] = field(default_factory=list)


@cache
def _shipped_encoders() -> dict[str, dict]:
    return {path.stem: yaml.safe_load(path.read_text()) for path in (conf_dir() / "encoder").glob("*.yaml")}


def encoder_name(config: Mapping[str, Any]) -> str:
    """The option of conf/encoder that a configuration has, and whether it has a semantic branch; ``unnamed``
    where it is another."""
    encoder = config.get("encoder")
    encoder = encoder if isinstance(encoder, Mapping) else {}
    branch = ", semantic branch" * (encoder.get("semantic") is not None)
    for name, shipped in sorted(_shipped_encoders().items()):
        if all(key in encoder and encoder[key] == shipped.get(key) for key in _ENCODER_KEYS):
            return name + branch
    return "unnamed" + branch


def model_variant(config: Mapping[str, Any], source: str, by: Sequence[str] = ()) -> Variant:
    """The row of a model.

    Args:
        config: the configuration that it was trained with.
        source: the file of the configuration, for messages.
        by: keys that tell rows apart beside model, encoder and ablation.

    Raises:
        InputError: the configuration has no recalibration, by which the ablation is told.
    """
    recalibration = entry(source, config, "recalibration", dict)
    compat = lookup(config, "compat.name")
    model = [str(lookup(config, "model.name") or "unnamed")]
    model += [f"compat {compat}"] * (compat not in (None, "none"))
    # No row of the ablation, which has 3D points or the image plane.
    model += ["neighbours by feature"] * (recalibration.get("neighborhood") == "feature")
    return Variant(
        kind="model",
        name="ours",
        model=", ".join(model),
        encoder=encoder_name(config),
        switches=switches_of(config),
        # Without such weights an encoder has learned from the loss of the rendering only.
        has_semantics=bool(lookup(config, "encoder.weights")),
        extra=tuple((key, str(lookup(config, key))) for key in by),
    )


def _run_records(path: Path, by: Sequence[str]) -> list[Record]:
    """The records of a ``metrics.json``."""
    content = read_results(path)
    source, place = content["provenance"], f"{path}: provenance"
    config = entry(place, source, "config", dict)
    # The configuration of `ghgs evaluate` does not say how the model was trained; that of its checkpoint
    # does, but for what the command line changed.
    trained = (
        config if source.get("checkpoint_config") is None else entry(place, source, "checkpoint_config", dict)
    )
    if source.get("model_config") is not None:
        trained = {**trained, **entry(place, source, "model_config", dict)}
    seed = entry(place, trained if "seed" in trained else source, "seed", int)
    measured = {name: config.get(name) for name in ("data", "metrics")}
    about = {"hash": source.get("config_hash"), "git": _git(place, source)}
    training = _training(place, source)
    rows = [{_PREDICTION.get(key, key): value for key, value in row.items()} for row in content["rows"]]
    names = metric_names(rows)
    records = []
    for (method, views, targets), subjects in by_protocol(rows).items():
        values = {
            subject: {n: v for n in names if (v := mean(row.get(n) for row in rows)) is not None}
            for subject, rows in subjects.items()
        }
        means = {n: m for n in names if (m := mean(own.get(n) for own in values.values())) is not None}
        is_model = method == METHOD
        records.append(
            Record(
                model_variant(trained, str(path), by) if is_model else Variant("baseline", method),
                Setting(
                    entry(place, source, "data.name", str),
                    entry(place, source, "data.split", str),
                    targets,
                    entry(place, source, "protocol.metrics", str),
                ),
                views,
                seed,
                means | training if is_model else means,
                str(path),
                len(subjects),
                values,
                {**trained, **measured} if is_model else None,
                about,
            )
        )
    return records


def _training(place: str, source: Mapping[str, Any]) -> dict[str, float]:
    """What the training took: ``steps``, ``seconds`` and ``peak_gb``, as far as the results say."""
    if source.get("training") is None:
        return {}
    said = entry(place, source, "training", dict)
    taken = {key: entry(f"{place}.training", said, key, float) for key in ("steps", "seconds", "peak_bytes")}
    peak = taken.pop("peak_bytes")
    taken["peak_gb"] = None if peak is None else peak / 1e9
    return {key: value for key, value in taken.items() if value is not None}


def _git(place: str, source: Mapping[str, Any]) -> dict[str, Any] | None:
    if source.get("git") is None:
        return None
    entry(place, source, "git.commit", str)
    return source["git"]


def _planned(path: Path, by: Sequence[str]) -> Planned | None:
    """The training run of a ``config.yaml``; None where it is that of another verb or incomplete."""
    try:
        config = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError, UnicodeDecodeError):
        return None
    if not isinstance(config, Mapping) or not all(k in config for k in ("trainer", "data")):
        return None
    if "recalibration" not in config:
        return None
    data, done = str(lookup(config, "data.name")), (path.parent / "metrics.json").exists()
    return Planned(model_variant(config, str(path), by), data, int(config.get("seed", 0)), done)


def read_sweep(folders: Sequence[Path], by: Sequence[str] = ()) -> Sweep:
    """All runs below some folders, finished or not.

    Args:
        folders: directories of runs.
        by: configuration keys that tell rows apart beside model, encoder and ablation.

    Raises:
        FileNotFoundError: a folder is missing.
        InputError: there is no finished run, or a ``metrics.json`` is damaged.
    """
    sweep = Sweep()
    for folder in folders:
        if not folder.is_dir():
            raise FileNotFoundError(f"{folder}: expected a directory of runs; found none")
        for path in sorted(folder.rglob("metrics.json")):
            sweep.records += _run_records(path, by)
        for path in sorted(folder.rglob("config.yaml")):
            if path.parent.name != ".hydra" and (planned := _planned(path, by)) is not None:
                sweep.planned.append(planned)
    if not sweep.records:
        names = ", ".join(map(str, folders))
        begun = f"{len(sweep.planned)} runs without one" if sweep.planned else "none"
        raise InputError(f"{names}: expected runs with a metrics.json below it; found {begun}")
    return sweep


def person_of(subject: str, unit: re.Pattern[str] | None) -> str:
    """The person of a subject: the first group of ``unit`` where it matches, else the subject itself."""
    match = unit.fullmatch(subject) if unit else None
    return match[1] if match else subject
