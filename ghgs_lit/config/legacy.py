"""Configurations that earlier versions wrote, in today's keys and class names.

Checkpoints and results carry the configuration of their run. The tables below say where its keys and
classes are now, so that they still load.
"""

import copy
from collections.abc import Callable, Mapping
from typing import Any

#: Classes that moved: old ``_target_``, new one.
TARGETS = {
    "ghgs_lit.data.HuMManDataModule": "ghgs_lit.data.datamodules.HuMManDataModule",
    "ghgs_lit.data.RenderedDataModule": "ghgs_lit.data.datamodules.RenderedDataModule",
    "ghgs_lit.data.ScansDataModule": "ghgs_lit.synthesis.datamodules.ScansDataModule",
    "ghgs_lit.data.SyntheticDataModule": "ghgs_lit.synthesis.datamodules.SyntheticDataModule",
    "ghgs_lit.data.THuman2DataModule": "ghgs_lit.synthesis.datamodules.THuman2DataModule",
    "ghgs_lit.data.ZJUMoCapDataModule": "ghgs_lit.data.datamodules.ZJUMoCapDataModule",
    "ghgs_lit.training.watch.Attention": "ghgs_lit.training.validation_pictures.Attention",
    "ghgs_lit.training.watch.Pictures": "ghgs_lit.training.validation_pictures.Pictures",
    "ghgs_lit.training.watch.PointClouds": "ghgs_lit.training.validation_pictures.PointClouds",
}

#: Keys that moved: old dotted key, new one (whole nodes too).
KEYS: dict[str, str] = {
    "data.render.vids": "data.render.views",
    "targets.training_vids": "targets.training_views",
    "targets.vid": "targets.view",
}

#: Values that changed their name: (key of today, old value) to the new one.
VALUES: dict[tuple[str, Any], Any] = {}

#: Changes that no table can say, applied last: each takes the configuration and changes it in place.
STEPS: list[Callable[[dict[str, Any]], None]] = []


def upgrade(config: Mapping[str, Any]) -> dict[str, Any]:
    """``config`` in today's keys; one of today comes back unchanged."""
    result = _renamed_targets(copy.deepcopy(dict(config)))
    for old, new in KEYS.items():
        _move(result, old.split("."), new.split("."))
    for (key, old), new in VALUES.items():
        *parents, name = key.split(".")
        node = _node(result, parents)
        if node is not None and name in node and node[name] == old:
            node[name] = new
    for step in STEPS:
        step(result)
    return result


def _renamed_targets(node: Any) -> Any:
    if isinstance(node, Mapping):
        return {
            key: TARGETS.get(value, value) if key == "_target_" else _renamed_targets(value)
            for key, value in node.items()
        }
    return [_renamed_targets(item) for item in node] if isinstance(node, list) else node


def _node(config: dict[str, Any], path: list[str]) -> dict[str, Any] | None:
    node: Any = config
    for name in path:
        node = node.get(name) if isinstance(node, dict) else None
    return node if isinstance(node, dict) else None


def _move(config: dict[str, Any], old: list[str], new: list[str]) -> None:
    source = _node(config, old[:-1])
    if source is None or old[-1] not in source:
        return
    value = source.pop(old[-1])
    target = config
    for name in new[:-1]:
        target = target.setdefault(name, {})
    target.setdefault(new[-1], value)
