"""Rows of a table: variants of our model by their configurations, baselines and other methods."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from ghgs_lit.config import conf_dir
from ghgs_lit.config.keys import (
    EXPECTED_TO_DIFFER,
    OF_TARGETS,
    OF_TRAINING,
    ablation_of,
    flatten,
    is_below,
    is_custom_ablation,
    lookup,
    switches_of,
)
from ghgs_lit.errors import require
from ghgs_lit.parsing import read_yaml

ABSENT = "absent"
"""Text for a key that a configuration does not have."""
TRAINING_COUNTS = "views.training_counts"
#: Keys that identify an encoder of conf/encoder; models change its other keys.
_ENCODER_KEYS = ("width", "heads", "depth", "layers", "vit")


@dataclass(frozen=True)
class Variant:
    """Identity of a row of a table.

    Attributes:
        kind: ``model`` (ours), ``baseline``, ``other`` (another method) or ``reported`` (by the
            paper).
        name: Name of the method.
        model: Name of the model, with its differences from the shipped one; empty for other methods.
        encoder: Name of its encoder; empty for other methods.
        ablation: The chosen option; empty for other methods.
        switches: Whether its 3D unprojection and semantic consistency are on.
        has_semantics: Whether the semantic features were trained (published weights or `ghgs
            pretext`); unknown before training starts, so it does not distinguish rows.
        extra: Further configuration keys and values that distinguish rows.
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
        """Whether this is a row of a user-defined ablation."""
        return bool(self.ablation) and is_custom_ablation(self.ablation)

    @property
    def titles(self) -> list[str]:
        """Differences of the row beyond model, encoder and ablation, in words."""
        return [f"{key}={value}" for key, value in self.extra]

    @property
    def trained(self) -> tuple:
        """Identity of the model without its ablation."""
        return (self.model, self.encoder, self.extra)


@cache
def _read_shipped(group: str) -> dict[str, dict]:
    return {path.stem: read_yaml(path) for path in (conf_dir() / group).glob("*.yaml")}


def encoder_name(config: Mapping[str, Any]) -> str:
    """Name of the encoder in a configuration.

    Args:
        config: Resolved configuration of a training.

    Returns:
        The option of conf/encoder with these sizes, or ``unnamed``, followed by ``, semantic branch``
        if it has one.
    """
    encoder = config.get("encoder")
    encoder = encoder if isinstance(encoder, Mapping) else {}
    branch = ", semantic branch" * (encoder.get("semantic") is not None)
    values = flatten({key: encoder.get(key) for key in _ENCODER_KEYS})
    for name, shipped in sorted(_read_shipped("encoder").items()):
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
    compat = lookup(config, "compat.name")
    ablation = ablation_of(config)
    encoder = encoder_name(config)
    # A user-defined option of conf/model can have the name of the one that it is based on.
    model = lookup(config, "chosen.model")
    if model is None or model in _read_shipped("model"):
        model = str(lookup(config, "model.name") or "unnamed")
    model += f", compat {compat}" * (compat not in (None, "none"))
    # A user-defined ablation is a row of the model's table, not another model.
    sets = lookup(config, "chosen.sets") or {}
    if is_custom_ablation(ablation) and any(is_below(key, ["encoder"]) for key in sets):
        encoder = encoder.replace("unnamed", str(lookup(config, "chosen.encoder")))
    extra = tuple((key, str(lookup(config, key))) for key in by)
    # Without such weights the encoder was trained by the rendering loss only.
    has_semantics = bool(lookup(config, "encoder.weights"))
    return Variant("model", "ours", model, encoder, ablation, switches_of(config), has_semantics, extra)


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
    several = [of_data for of_data in counts.values() if len(set(of_data.values())) > 1]
    return dict(itertools.chain.from_iterable(map(dict.items, several)))


def find_keys_of_rows(configs: Iterable[Mapping[str, Any]]) -> list[str]:
    """Keys of views and targets in which runs that could share a row differ.

    Keys of the training are compared between runs on the same data; keys of the targets between those
    with a protocol of the same name, too.
    """
    values: dict[tuple[str, ...], set[str]] = {}
    for config in configs:
        data = str(lookup(config, "data.name"))
        protocol = str(lookup(config, "targets.name"))
        places = [(key, data) for key in OF_TRAINING] + [(key, data, protocol) for key in OF_TARGETS]
        for place in places:
            values.setdefault(place, set()).add(str(lookup(config, place[0])))
    return [key for (key, *_), different in values.items() if len(different) > 1]


def find_differences(
    configs: Sequence[Mapping[str, Any]], expected: Iterable[str] = EXPECTED_TO_DIFFER
) -> dict[str, list[str]]:
    """Find the dotted keys in which configurations differ.

    Args:
        configs: Configurations of several runs.
        expected: Keys that may differ, with those below them.

    Returns:
        Different values of each key as text, ``ABSENT`` where a configuration does not have it.
    """
    flat = [flatten(config) for config in configs]
    texts = {}
    for key in dict.fromkeys(itertools.chain.from_iterable(flat)):
        values = list(dict.fromkeys(str(values.get(key, ABSENT)) for values in flat))
        if len(values) > 1 and not is_below(key, expected):
            texts[key] = values
    return texts


def describe(keys: Mapping[str, Sequence[str]]) -> str:
    """The first keys and values of :func:`find_differences`, such as ``optimizer.lr (0.001, 0.0001)``."""
    shown = [f"`{key}` ({', '.join(values[:4])})" for key, values in list(keys.items())[:6]]
    return ", ".join(shown) + (f" and {len(keys) - 6} more" if len(keys) > 6 else "")
