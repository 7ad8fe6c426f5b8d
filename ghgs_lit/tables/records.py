"""What runs measured, as records: of which method, under which setting, for which subject.

A run is told by what its configuration says, never by the name of its directory.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml

from ghgs_lit.config import conf_dir
from ghgs_lit.config.legacy import upgrade
from ghgs_lit.errors import InputError
from ghgs_lit.runs.results import METHOD, mean, metric_names, read_results

ABLATIONS = {
    (False, False): "neither",
    (False, True): "no_unprojection",
    (True, False): "no_semantic",
    (True, True): "full",
}
"""The ablation's name by its switches (3D unprojection, semantic consistency), in the tables' order."""

# What tells an encoder of conf/encoder; models change the rest of it.
_ENCODER_KEYS = ("patch_size", "width", "heads", "depth", "layers", "vit")


@dataclass(frozen=True)
class Variant:
    """What a row of a table stands for. ``kind``: ``model`` (ours), ``baseline``, ``other`` or ``reported``.

    ``extra`` are further configuration keys that tell rows apart, with their values. Where an encoder comes
    from is known when training starts only, and tells no rows apart.
    """

    kind: str
    name: str
    model: str = ""
    encoder: str = ""
    switches: tuple[bool, bool] | None = None
    has_semantics: bool = field(default=True, compare=False)
    extra: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Setting:
    """What measured numbers must share to stand in one column."""

    data: str
    split: str
    targets: str
    protocol: str


@dataclass(frozen=True)
class Record:
    """One run of one method with ``views`` inputs: means over subjects, and each subject's values.

    ``subjects`` is empty where only means are known; ``count`` says over how many subjects. ``values``
    hold what subjects (averaged over their targets) reached, by metric.
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
    """A run that was started and has no results (yet), or that has: which cells it fills."""

    variant: Variant
    data: str
    seed: int
    done: bool


@dataclass
class Sweep:
    """Everything below the directories of a sweep."""

    records: list[Record] = field(default_factory=list)
    planned: list[Planned] = field(default_factory=list)


def lookup(config: Mapping[str, Any], key: str) -> Any:
    """The value at a dotted key; None where there is none."""
    node: Any = config
    for part in key.split("."):
        node = node.get(part) if isinstance(node, Mapping) else None
    return node


@cache
def _shipped_encoders() -> dict[str, dict]:
    return {path.stem: yaml.safe_load(path.read_text()) for path in (conf_dir() / "encoder").glob("*.yaml")}


def encoder_name(config: Mapping[str, Any]) -> str:
    """Which of the shipped encoders a configuration has; ``unnamed`` for another."""
    encoder = config.get("encoder") or {}
    for name, shipped in sorted(_shipped_encoders().items()):
        if all(key in encoder and encoder[key] == shipped.get(key) for key in _ENCODER_KEYS):
            return name
    return "unnamed"


def model_variant(config: Mapping[str, Any], source: str, by: Sequence[str] = ()) -> Variant:
    """The row of a model that was trained with ``config``."""
    ablation = config.get("ablation")
    if not isinstance(ablation, Mapping):
        raise InputError(f"{source}: expected a run with ablation=...; found none in its configuration")
    compat = lookup(config, "compat.name")
    model = str(lookup(config, "model.name") or "unnamed")
    return Variant(
        kind="model",
        name="ours",
        model=model if compat in (None, "none") else f"{model}, compat {compat}",
        encoder=encoder_name(config),
        switches=(bool(ablation["unprojection"]), bool(ablation["semantic"])),
        # Only an encoder that starts from published weights has seen anything but this data's photographs.
        has_semantics=bool(lookup(config, "encoder.weights")),
        extra=tuple((key, str(lookup(config, key))) for key in by),
    )


def _groups(rows: Sequence[Mapping[str, Any]]) -> Iterator[tuple[tuple, dict[str, list]]]:
    """Rows by method, views and targets, then by subject."""
    groups: dict[tuple, dict[str, list]] = {}
    for row in rows:
        key = (row["method"], row["views"], row["targets"])
        groups.setdefault(key, {}).setdefault(row["subject"], []).append(row)
    yield from groups.items()


def _run_records(path: Path, by: Sequence[str]) -> list[Record]:
    """The records of one ``metrics.json``."""
    content = read_results(path)
    source = content["provenance"]
    # `ghgs evaluate` has a configuration of its own; what the model is stands in its checkpoint.
    trained = source.get("checkpoint_config") or source["config"]
    measured = {name: source["config"].get(name) for name in ("data", "metrics")}
    names = metric_names(content["rows"])
    records = []
    for (method, views, targets), subjects in _groups(content["rows"]):
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
                    str(source["data"]["name"]),
                    str(source["data"]["split"]),
                    targets,
                    str(source["protocol"]["metrics"]),
                ),
                views,
                int(trained.get("seed", source["seed"])),
                means,
                str(path),
                len(subjects),
                values,
                {**trained, **measured} if is_model else None,
                {"hash": source.get("config_hash"), "git": source.get("git")},
            )
        )
    return records


def _planned(path: Path, by: Sequence[str]) -> Planned | None:
    """The training run of a ``config.yaml``; None for another file, or one that is being written."""
    try:
        config = yaml.safe_load(path.read_text())
    except (OSError, yaml.YAMLError, UnicodeDecodeError):
        return None
    if not isinstance(config, Mapping) or not all(k in config for k in ("ablation", "trainer", "data")):
        return None
    config = upgrade(config)
    data, done = str(lookup(config, "data.name")), (path.parent / "metrics.json").exists()
    return Planned(model_variant(config, str(path), by), data, int(config.get("seed", 0)), done)


def read_sweep(folders: Sequence[Path], by: Sequence[str] = ()) -> Sweep:
    """All runs below ``folders``, finished or not.

    Args:
        by: configuration keys that tell rows apart beside the model, its encoder and its ablation.

    Raises:
        FileNotFoundError: a folder is missing.
        InputError: there is no finished run, or a ``metrics.json`` that is none.
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
    """Whom a subject is of: the first group of ``unit``, where subjects are frames of people."""
    match = unit.fullmatch(subject) if unit else None
    return match[1] if match else subject
