"""What the authors' code computes otherwise: the switches of ``compat=release``."""

from collections.abc import Mapping
from functools import cache
from typing import Any

from omegaconf import OmegaConf

from ghgs_lit.config import conf_dir


@cache
def release_switches() -> dict[tuple[str, ...], Any]:
    """Each switch of the model by the path of its key, with the release's value."""
    node = OmegaConf.to_container(OmegaConf.load(conf_dir() / "compat" / "release.yaml"))
    for choice in node["defaults"]:
        ((group, option),) = ((key.removeprefix("override /"), value) for key, value in choice.items())
        if group != "metrics":
            node[group] = OmegaConf.to_container(OmegaConf.load(conf_dir() / group / f"{option}.yaml"))
    return {
        (group, key): value
        for group, values in node.items()
        if group not in ("defaults", "compat")
        for key, value in values.items()
    }


def differences(config: Mapping[str, Any], other: Mapping[str, Any] | None = None) -> list[str]:
    """The switches in which the models of two configurations differ (``other`` None: from the release's)."""
    found = []
    for (group, key), value in release_switches().items():
        expected = value if other is None else (other.get(group) or {}).get(key)
        own = (config.get(group) or {}).get(key)
        if own != expected:
            found.append(f"{group}.{key}={own} for {expected}")
    return found
