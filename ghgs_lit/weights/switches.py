"""Switches of ``compat=release``: differences of the authors' code from the paper."""

from collections.abc import Mapping
from functools import cache
from typing import Any, Literal

from omegaconf import OmegaConf

from ghgs_lit.config import conf_dir
from ghgs_lit.config.keys import lookup
from ghgs_lit.config.options import Options


class CompatOptions(Options):
    """Name of the code that a configuration reproduces; the files in ``conf/compat`` set the switches."""

    group = "compat"
    name: Literal["none", "release"] = "none"
    """none: the model as configured; release: the authors' code."""


@cache
def release_switches() -> dict[tuple[str, ...], Any]:
    """Value of each of the model's switches in the release, by (group, key)."""
    node = OmegaConf.to_container(OmegaConf.load(conf_dir() / "compat" / "release.yaml"))
    switches = {}
    for group, values in node.items():
        if group not in ("defaults", "compat", "renderer"):  # these are not part of the model
            switches |= {(group, key): value for key, value in values.items()}
    return switches


def differences(config: Mapping[str, Any], other: Mapping[str, Any] | None = None) -> list[str]:
    """List the switches in which two configurations differ, as ``<key>=<value> for <other value>``.

    Args:
        config: the whole configuration.
        other: the other one; None: the release. Stages missing from it (a checkpoint of
            ``ghgs pretext`` lacks some) are not compared.
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
