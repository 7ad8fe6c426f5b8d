"""Cases of a benchmark: one model in every preset of ``conf/skip`` and with every value
of the knobs."""

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

YARDSTICK = "none"  #: Preset that all others are compared with
#: Nodes of a configuration that a model is built from, beside ``skip``.
MODEL_NODES = (*STAGES, "rounds", "model")
#: Nodes that knobs can change
KNOBS = (*STAGES, "rounds", "skip", "model", "renderer", "precision")


@dataclass(frozen=True)
class Source:
    """Weights (path of a checkpoint; None: random) and the configuration,
    with :data:`MODEL_NODES`."""

    config: Mapping[str, Any]
    checkpoint: str | None


@dataclass(frozen=True)
class Case:
    """A model to measure."""

    preset: str
    knobs: Mapping[str, Any]  #: changed values by key
    predictor: Predictor  #: with a model in evaluation mode, on its device
    renderer: Renderer
    budget_db: float | None  #: PSNR that the preset may lose against the yardstick; None: no budget
    max_rel_diff: float | None  #: allowed difference over its condition; None: any
    is_trained: bool

    @property
    def label(self) -> str:
        """Unique name of the case."""
        changes = [f"{key}={value}" for key, value in self.knobs.items()]
        return " ".join([self.preset, *changes])

    @property
    def is_yardstick(self) -> bool:
        return self.preset == YARDSTICK and not self.knobs


def combinations(knobs: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """All combinations of values of the knobs.

    Args:
        knobs: list of values by dotted key.

    Returns:
        Value by key of each combination; without knobs the empty one.

    Raises:
        InputError: a knob does not exist, or has no list of values.
    """
    for key, values in knobs.items():
        require(is_below(key, KNOBS), f"knobs.{key}", f"a key of {', '.join(KNOBS)}", key)
        is_list = isinstance(values, Sequence) and not isinstance(values, str)
        require(is_list and bool(values), f"knobs.{key}", "a list with a value", values)
    return [dict(zip(knobs, values, strict=True)) for values in itertools.product(*knobs.values())]


def case_config(
    source: Source, skip: Mapping[str, Any], knobs: Mapping[str, Any], shared: Mapping[str, Any]
) -> dict[str, Any]:
    """Configuration of a case.

    Args:
        source: has the configuration of the model.
        skip: values of the preset.
        knobs: changed values by dotted key.
        shared: nodes that all cases have: ``renderer``, ``precision``.

    Returns:
        The nodes :data:`KNOBS`, as far as the source has them, as plain data.

    Raises:
        InputError: it lacks the key of a knob.
    """
    model_nodes = {name: source.config[name] for name in MODEL_NODES if name in source.config}
    node = OmegaConf.create({**model_nodes, **shared, "skip": dict(skip)})
    for key, value in knobs.items():
        if OmegaConf.select(node, key, default=None) is None:
            require(key in flatten(OmegaConf.to_container(node)), f"knobs.{key}", "an existing key", key)
        OmegaConf.update(node, key, value)
    return OmegaConf.to_container(node, resolve=True)


def cases_of(
    source: Source,
    presets: Mapping[str, Mapping[str, Any]],
    knobs: Mapping[str, Sequence[Any]],
    shared: Mapping[str, Any],
    device: torch.device,
    seed: int = 0,
) -> list[Case]:
    """Cases of a model: every preset with every combination of knobs;
    they share one copy of the weights.

    Args:
        source: weights and configuration.
        presets: values of files of ``conf/skip`` by name.
        knobs: list of values by dotted key.
        shared: nodes that all cases have: ``renderer``, ``precision``.
        device: where the models are.
        seed: of random weights.

    Returns:
        The cases; the yardstick, if among the presets, comes first, without knobs.

    Raises:
        InputError: the model refuses a preset or knob, or the weights do not fit it.
    """
    choices = list(itertools.product(presets, combinations(knobs)))
    if YARDSTICK in presets:
        choices = [(YARDSTICK, {}), *(choice for choice in choices if choice != (YARDSTICK, {}))]
    state: dict[str, Tensor] = {}
    cases = []
    for name, change in choices:
        skip = presets[name]
        config = case_config(source, skip, change, shared)
        model = _model(source, config, state, seed, device).to(device).eval()
        state = state or model.state_dict()
        predictor = Predictor(model, precision=config["precision"])
        # Budgets hold for presets without knobs.
        budget_db, max_rel_diff = (None if change else skip.get(key) for key in ("budget_db", "max_rel_diff"))
        renderer = build(config["renderer"], "renderer")
        is_trained = source.checkpoint is not None
        cases.append(Case(name, change, predictor, renderer, budget_db, max_rel_diff, is_trained))
    return cases


def _model(
    source: Source, config: dict[str, Any], state: dict[str, Tensor], seed: int, device: torch.device
) -> GHGS:
    """A model with the tensors of ``state``, or, if that is empty, with the source's own.

    Args:
        source: weights and configuration.
        config: of the case.
        state: tensors of an earlier case by name, which are shared, not copied.
        seed: of random weights.
        device: where the weights will be moved to.

    Raises:
        InputError: the weights do not fit the configuration.
    """
    if not state and source.checkpoint is None:
        return random_model(config, seed)
    model = GHGS.from_config(config, empty=True)
    if not state:
        load_weights(model, source.checkpoint, device=device)
        return model
    require_fit(model, state, "knobs")
    model.load_state_dict(state, assign=True)
    if source.checkpoint is not None:
        check_preset(model, read_checkpoint(source.checkpoint), source.checkpoint)
    return model
