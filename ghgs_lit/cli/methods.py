"""The methods that `ghgs evaluate` measures, as configured."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from ghgs_lit.cli.inputs import MODEL_NODES, build_renderer, load_model
from ghgs_lit.evaluation.baselines import BASELINES, baseline
from ghgs_lit.evaluation.measure import Method, ModelMethod
from ghgs_lit.model import GHGS
from ghgs_lit.prediction.refinement import CameraRefinement, Refinement
from ghgs_lit.weights.checkpoint import read_checkpoint


def trained_method(config: Mapping[str, Any], device: torch.device) -> tuple[ModelMethod, dict[str, Any]]:
    """The model of ``config["checkpoint"]`` on a device, refined as the verb says, and facts about it."""
    renderer, model = build_renderer(config, device), load_model(config, device)
    checkpoint = read_checkpoint(config["checkpoint"])
    facts: dict[str, Any] = {
        "checkpoint_config": checkpoint["config"],
        "model_config": {node: config[node] for node in MODEL_NODES if node in config},
        "parameters": {"total": sum(p.numel() for p in model.parameters())},
    }
    if "global_step" in checkpoint:
        facts["training"] = {"steps": checkpoint["global_step"]}
    steps, rounds = config.get("refine"), config.get("refine_cameras")
    refinement = Refinement(steps, renderer) if steps else None
    cameras = CameraRefinement(rounds, model, renderer) if rounds else None
    return ModelMethod(model, renderer, refinement, cameras), facts


def baselines_of(
    names: str | Sequence[str], config: Mapping[str, Any], device: torch.device
) -> dict[str, Method]:
    """The baselines called ``names``, or ``all``; other arguments as for :func:`trained_method`."""
    names = BASELINES if names == "all" else [names] if isinstance(names, str) else names
    renderer = build_renderer(config, device)

    def untrained() -> GHGS:
        return GHGS.from_config(config).to(device)

    return {name: baseline(name, renderer, untrained, config["per_scene"]) for name in names}
