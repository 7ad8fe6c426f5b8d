"""Methods that a user would pick instead of a model, and simple ones that it must beat."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import torch

from ghgs_lit.errors import choice
from ghgs_lit.evaluation.baselines.hull import hull_depth
from ghgs_lit.evaluation.baselines.images import black, nearest_view
from ghgs_lit.evaluation.baselines.per_scene import PerScene
from ghgs_lit.evaluation.baselines.photo_depth import photo_depth
from ghgs_lit.evaluation.baselines.splats import body_depth, splats_at, splatted, true_depth
from ghgs_lit.evaluation.measure import Method, ModelMethod, Renderer

__all__ = ["BASELINES", "baseline", "black", "nearest_view", "splats_at", "splatted"]

#: By name, what gives the depth of a baseline's discs.
DEPTHS = {"body_depth": body_depth, "hull": hull_depth, "photo_depth": photo_depth, "true_depth": true_depth}
BASELINES = ("black", "nearest_view", *DEPTHS, "per_scene", "untrained")


def baseline(
    name: str, renderer: Renderer, untrained: Callable[[], torch.nn.Module], per_scene: Mapping[str, Any]
) -> Method:
    """The baseline called ``name``, one of ``BASELINES``. ``untrained``: builds a model with random weights,
    for the baseline ``untrained``."""
    choice("baselines", name, BASELINES)
    if name in DEPTHS:
        return partial(splatted, depth_of=DEPTHS[name], renderer=renderer)
    if name == "per_scene":
        return PerScene(renderer, **per_scene)
    if name == "untrained":
        return ModelMethod(untrained().eval(), renderer)
    return {"black": black, "nearest_view": nearest_view}[name]
