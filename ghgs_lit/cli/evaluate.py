"""``ghgs evaluate``: evaluate a checkpoint, baselines, or both on the same targets."""

from typing import TYPE_CHECKING, Any

import lightning.pytorch as L
import torch

from ghgs_lit.cli import inputs
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.baselines import BASELINES, baseline
from ghgs_lit.evaluation.measure import Method, ModelMethod
from ghgs_lit.evaluation.report import check_evaluation, measure_and_write
from ghgs_lit.refinement import CameraRefinement, Refinement
from ghgs_lit.weights.checkpoint import read_checkpoint

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Evaluate


def trained_method(run: "Evaluate", device: torch.device) -> tuple[ModelMethod, dict[str, Any]]:
    """Model of a checkpoint with the chosen refinement, and facts about it.

    Args:
        run: Run with a checkpoint and its model nodes.
        device: Device on which the model runs.

    Returns:
        The method, and provenance for ``metrics.json``: ``checkpoint_config``, ``model_config``,
        ``parameters`` and, if known, ``training``.

    Raises:
        InputError: The weights do not fit, or the renderer does not run on ``device``.
    """
    config = run.plain
    renderer = inputs.build_renderer(run, device)
    predictor = inputs.load_predictor(config, run.checkpoint, device, run.precision)
    checkpoint = read_checkpoint(run.checkpoint)
    facts: dict[str, Any] = {
        "checkpoint_config": checkpoint["config"],
        "model_config": {node: config[node] for node in inputs.MODEL_NODES if node in config},
        "parameters": {"total": sum(p.numel() for p in predictor.model.parameters())},
    }
    if "global_step" in checkpoint:
        facts["training"] = {"steps": checkpoint["global_step"]}
    refinement = Refinement(run.refine, renderer) if run.refine else None
    cameras = CameraRefinement(run.refine_cameras, predictor, renderer) if run.refine_cameras else None
    return ModelMethod(predictor, renderer, refinement, cameras), facts


def run(verb: "Evaluate") -> None:
    """Evaluate a checkpoint, baselines or both, and write the results.

    Raises:
        InputError: The configuration, a checkpoint or the data is wrong.
    """
    directory = output_dir()
    verb = inputs.with_chosen_targets(inputs.with_trained_data(verb))
    if verb.checkpoint is not None:
        verb = verb.replace(**inputs.model_of(verb.checkpoint, verb))
    write_config(verb, directory)
    L.seed_everything(verb.seed, workers=True, verbose=False)
    device = inputs.pick_device(verb.device)
    if verb.checkpoint is None and not verb.baselines:
        raise InputError("checkpoint: expected a checkpoint or baselines=[...]; found neither")
    methods: dict[str, Method] = {}
    facts = {"verb": "evaluate", "choices": inputs.choices(), "checkpoint": verb.checkpoint}
    if verb.checkpoint is not None:
        methods["model"], model_facts = trained_method(verb, device)
        facts |= model_facts
    names = [verb.baselines] if isinstance(verb.baselines, str) else verb.baselines
    renderer = inputs.build_renderer(verb, device)
    for name in BASELINES if names == ["all"] else names:
        methods[name] = baseline(name, renderer, verb.per_scene.steps)
    data = inputs.build_data(verb)
    if verb.checkpoint is not None:
        inputs.check_size(data, methods["model"].predict)
    check_evaluation(verb, data)
    announce(measure_and_write(methods, data, verb, directory, device, **facts))
