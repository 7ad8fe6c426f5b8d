"""Cases of a benchmark: one model in every preset of ``conf/skip`` and with every value of the knobs."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from omegaconf import OmegaConf
from torch import Tensor

from ghgs_lit.config import build
from ghgs_lit.config.keys import flatten, is_below
from ghgs_lit.diagnostics.benchmark.scene import random_model
from ghgs_lit.errors import require
from ghgs_lit.evaluation.measure import Renderer
from ghgs_lit.execution import Predictor
from ghgs_lit.method.model import GHGS, STAGES
from ghgs_lit.weights.checkpoint import check_preset, load_weights, read_checkpoint, require_fit

REFERENCE = "none"  #: Preset that all others are compared with
#: Nodes of a configuration that define a case; ``knobs`` change keys of them
KNOBS = (*STAGES, "rounds", "skip", "model", "renderer", "precision")


@dataclass(frozen=True)
class Case:
    """A model to measure."""

    label: str  #: its preset and changed values, such as ``fast recalibration.k=4``; unique
    predictor: Predictor  #: with a model in evaluation mode, on its device
    renderer: Renderer
    budget_db: float | None  #: PSNR that the preset may lose against the reference; None: no budget
    max_rel_diff: float | None  #: allowed ``rel_diff`` from the reference; None: any
    is_trained: bool


def combinations(knobs: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """All combinations of the values of the knobs.

    Args:
        knobs: list of values by dotted key.

    Returns:
        Value by key for each combination; without knobs one empty mapping.

    Raises:
        InputError: a knob does not exist, or has no list of values.
    """
    for key, values in knobs.items():
        require(is_below(key, KNOBS), f"knobs.{key}", f"a key of {', '.join(KNOBS)}", key)
        is_list = isinstance(values, Sequence) and not isinstance(values, str)
        require(is_list and bool(values), f"knobs.{key}", "a list with a value", values)
    return [dict(zip(knobs, values, strict=True)) for values in itertools.product(*knobs.values())]


def make_cases(
    config: Mapping[str, Any],
    checkpoint: str | None,
    presets: Mapping[str, Mapping[str, Any]],
    knobs: Mapping[str, Sequence[Any]],
    device: torch.device,
    seed: int = 0,
) -> list[Case]:
    """Cases of a model: every preset with every combination of knobs; they share one copy of the weights.

    Args:
        config: nodes of the model, and ``renderer`` and ``precision``.
        checkpoint: path of the weights; None: random weights.
        presets: values of files of ``conf/skip`` by name, the reference among them.
        knobs: list of values by dotted key.
        device: of the models.
        seed: of random weights.

    Returns:
        The cases, the reference first.

    Raises:
        InputError: a preset or knob is not valid for the model, or the weights do not fit it.
    """
    first = (REFERENCE, {})
    choices = [
        first,
        *(choice for choice in itertools.product(presets, combinations(knobs)) if choice != first),
    ]
    state: dict[str, Tensor] = {}
    cases = []
    for name, change in choices:
        skip = presets[name]
        node = OmegaConf.create({key: config[key] for key in KNOBS if key in config} | {"skip": dict(skip)})
        keys = flatten(OmegaConf.to_container(node))
        for key, value in change.items():
            require(any(is_below(known, [key]) for known in keys), f"knobs.{key}", "an existing key", key)
            OmegaConf.update(node, key, value)
        plain = OmegaConf.to_container(node, resolve=True)
        model = _model(plain, checkpoint, state, seed, device).to(device).eval()
        state = state or model.state_dict()
        label = " ".join([name, *(f"{key}={value}" for key, value in change.items())])
        # Budgets hold for presets without knobs.
        budgets = (None if change else skip.get(key) for key in ("budget_db", "max_rel_diff"))
        predictor = Predictor(model, precision=plain["precision"])
        renderer = build(plain["renderer"], "renderer")
        cases.append(Case(label, predictor, renderer, *budgets, checkpoint is not None))
    return cases


def _model(
    config: dict[str, Any], checkpoint: str | None, state: dict[str, Tensor], seed: int, device: torch.device
) -> GHGS:
    """A model that shares the tensors of ``state``; if that is empty, with weights of the checkpoint or
    random ones."""
    if not state and checkpoint is None:
        return random_model(config, seed)
    model = GHGS.from_config(config, empty=True)
    if not state:
        load_weights(model, checkpoint, device=device)
        return model
    require_fit(model, state, "knobs")
    model.load_state_dict(state, assign=True)
    if checkpoint is not None:
        check_preset(model, read_checkpoint(checkpoint), checkpoint)
    return model
