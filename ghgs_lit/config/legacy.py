"""Configurations of earlier versions in today's keys and class names.

Checkpoints and results carry the configuration of their run. The tables below map its old names to today's,
so that they still load.
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
    "depth_head.agreement": "depth_head.consistency_depths",
    "depth_head.views": "depth_head.pixels",
    "encoder.interval_input": "encoder.bounds_input",
    "feature_cache.ring": "feature_cache.margin",
    "gaussian_head.agreement": "gaussian_head.photo_consistency",
    "optimizer.hold": "optimizer.freeze_until",
    "points": "unprojection",
    "skip.depth_views": "skip.depth_pixels",
    "targets.training_vids": "targets.training_views",
    "targets.vid": "targets.view",
}

#: Values that changed their name: (key of today, old value) to the new one.
VALUES: dict[tuple[str, Any], Any] = {}

#: Keys that are gone from the command line, and what does now what they said.
GONE = {
    "ablation.semantic": "recalibration.similarity=none",
    "ablation.unprojection": "recalibration.neighborhood=image_plane",
}

#: Options that changed their name: (group, old option) to the new one. Results list the options of their run.
OPTIONS = {
    ("optimizer", "pilot"): "from_scratch",
}


def _bounds_become_a_stage(config: dict[str, Any]) -> None:
    """``depth_head.bounds`` and ``depth_head.search`` are the node ``bounds``."""
    head = config.get("depth_head")
    if not isinstance(head, dict) or "bounds" in config:
        return
    kind, search = head.get("bounds", "box"), head.get("search") or {}
    if kind not in ("box", "hull", "none"):
        return  # no configuration of this package
    head.pop("bounds", None)
    head.pop("search", None)
    if kind == "none":
        search = {}
    elif kind == "box":
        search = {name: value for name, value in search.items() if name != "samples"}
    target = {"box": "SubjectBox", "hull": "VisualHull", "none": "NoBounds"}[kind]
    config["bounds"] = {"_target_": f"ghgs_lit.bounds.{target}", **search}


def _unprojection_names_its_class(config: dict[str, Any]) -> None:
    """The node ``unprojection`` has a ``_target_``, and every model has the node."""
    if "depth_head" in config:
        node = config.setdefault("unprojection", {})
        node.setdefault("_target_", "ghgs_lit.geometry.unprojection.Unprojection")


def _heads_name_what_they_skip(config: dict[str, Any]) -> None:
    """The heads have their own copies of ``skip.pixels``; ``views`` said the same of whole views."""
    skip, head, recalibration = (config.get(name) for name in ("skip", "depth_head", "recalibration"))
    gaussian_head = config.get("gaussian_head")
    if isinstance(gaussian_head, dict):
        gaussian_head.pop("views", None)
    if not (isinstance(skip, dict) and isinstance(head, dict) and isinstance(recalibration, dict)):
        return
    pixels = skip.get("pixels")
    views = skip.pop("views", pixels)
    if views is not None:
        of_depth = skip.setdefault("depth_pixels", {"subject": views, "all": "all"})
        head.setdefault("pixels", of_depth.get(recalibration.get("tokens", "subject"), "all"))
    if pixels is not None and isinstance(gaussian_head, dict):
        gaussian_head.setdefault("pixels", pixels)


def _ablation_is_what_the_model_does(config: dict[str, Any]) -> None:
    """The node ``ablation`` repeated what ``recalibration`` does, and could say something else."""
    labels = config.pop("ablation", None)
    if isinstance(labels, dict) and "recalibration" not in config:
        config["recalibration"] = {
            "neighborhood": "xyz" if labels.get("unprojection") else "image_plane",
            "similarity": "product" if labels.get("semantic") else "none",
        }


def _encoders_keep_all_tokens(config: dict[str, Any]) -> None:
    """Encoders had no choice of tokens: they kept all."""
    for name in ("skip", "encoder"):
        if isinstance(config.get(name), dict):
            config[name].setdefault("tokens", "all")
            config[name].setdefault("margin", 1)


def _crops_become_windows(config: dict[str, Any]) -> None:
    """``skip.crop`` let the stages see crops around the subject: about the patches of a window."""
    skip, encoder = (config.get(name) for name in ("skip", "encoder"))
    choices = skip.get("choices") if isinstance(skip, dict) else None
    presets = [skip, *(choices.values() if isinstance(choices, dict) else ())]
    for preset in presets:
        if isinstance(preset, dict) and preset.pop("crop", False) and preset.get("tokens", "all") == "all":
            preset.update(tokens="window", margin=0)
            if preset is skip and isinstance(encoder, dict):
                encoder.update(tokens="window", margin=0)


#: Changes that no table can express, applied last: each takes the configuration and changes it in place.
STEPS: list[Callable[[dict[str, Any]], None]] = [
    _ablation_is_what_the_model_does,
    _bounds_become_a_stage,
    _encoders_keep_all_tokens,
    _crops_become_windows,
    _heads_name_what_they_skip,
    _unprojection_names_its_class,
]


def upgrade(config: Mapping[str, Any]) -> dict[str, Any]:
    """``config`` in today's keys; one of today's version is returned unchanged."""
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


def upgrade_provenance(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """The provenance of a result with its configurations and chosen options in today's names."""
    result = dict(provenance)
    for key in ("config", "checkpoint_config", "model_config"):
        if isinstance(result.get(key), Mapping):
            result[key] = upgrade(result[key])
    if isinstance(result.get("choices"), Mapping):
        chosen = result["choices"].items()
        result["choices"] = {group: OPTIONS.get((group, option), option) for group, option in chosen}
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
