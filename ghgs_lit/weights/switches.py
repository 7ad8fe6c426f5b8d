"""Switches of ``compat=release``, with which the authors' code differs from the paper."""

from collections.abc import Mapping
from functools import cache
from typing import Any, Literal

from omegaconf import OmegaConf

from ghgs_lit.config import conf_dir
from ghgs_lit.config.keys import lookup
from ghgs_lit.config.options import Options


class CompatOptions(Options):
    """Name of the code that a configuration reproduces; ``conf/compat`` sets the switches."""

    group = "compat"
    name: Literal["none", "release"] = "none"
    """none: the model as configured; release: the authors' code."""


@cache
def release_switches() -> dict[tuple[str, ...], Any]:
    """The release's value of each switch of the model, by (group, key)."""
    node = OmegaConf.to_container(OmegaConf.load(conf_dir() / "compat" / "release.yaml"))
    switches = {}
    for group, values in node.items():
        if group not in ("defaults", "compat", "renderer"):  # which are no parts of the model
            switches |= {(group, key): value for key, value in values.items()}
    return switches


def differences(config: Mapping[str, Any], other: Mapping[str, Any] | None = None) -> list[str]:
    """Switches in which a configuration differs from another.

    Args:
        config: the whole configuration.
        other: another one; None: the release. Stages that it lacks, as a checkpoint of
            ``ghgs pretext`` does, are not compared.

    Returns:
        A text ``<key>=<value> for <other value>`` for each.
    """
    texts = []
    for (group, key), value in release_switches().items():
        if other is not None and group not in other:
            continue
        expected = value if other is None else lookup(other, f"{group}.{key}")
        configured = lookup(config, f"{group}.{key}")
        if configured != expected:
            texts.append(f"{group}.{key}={configured} for {expected}")
    return texts
