"""``ghgs evaluate``: measure a checkpoint, baselines, or both on the same targets."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import lightning.pytorch as L
import torch
from omegaconf import DictConfig

from ghgs_lit.cli import inputs
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.config import resolve
from ghgs_lit.errors import InputError, require
from ghgs_lit.evaluation.baselines import BASELINES, baseline
from ghgs_lit.evaluation.measure import Method, ModelMethod, decisions_of
from ghgs_lit.evaluation.protocols import check_evaluation
from ghgs_lit.evaluation.report import measure_and_write
from ghgs_lit.model import GHGS
from ghgs_lit.refinement import CameraRefinement, Refinement
from ghgs_lit.runs.results import METHOD, read_results
from ghgs_lit.weights.checkpoint import read_checkpoint

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Evaluate


def trained_method(
    options: "Evaluate", config: Mapping[str, Any], device: torch.device
) -> tuple[ModelMethod, dict[str, Any]]:
    """The model of a checkpoint with the chosen refinement, and facts about it.

    Args:
        options: keys of the verb, with a checkpoint.
        config: the whole configuration as plain data, with the checkpoint's model.
        device: where the model runs.

    Returns:
        The method, and provenance for ``metrics.json``: ``checkpoint_config``, ``model_config``,
        ``parameters`` and, where it is known, ``training``.

    Raises:
        InputError: the weights do not fit, or the renderer does not run on ``device``.
    """
    renderer = inputs.build_renderer(config, device)
    model = inputs.load_model(config, device)
    checkpoint = read_checkpoint(options.checkpoint)
    facts: dict[str, Any] = {
        "checkpoint_config": checkpoint["config"],
        "model_config": {node: config[node] for node in inputs.MODEL_NODES if node in config},
        "parameters": {"total": sum(p.numel() for p in model.parameters())},
    }
    if "global_step" in checkpoint:
        facts["training"] = {"steps": checkpoint["global_step"]}
    rounds = options.refine_cameras
    refinement = Refinement(options.refine, renderer) if options.refine else None
    cameras = CameraRefinement(rounds, model, renderer) if rounds else None
    return ModelMethod(model, renderer, refinement, cameras), facts


def baselines_of(
    names: str | Sequence[str], config: Mapping[str, Any], device: torch.device
) -> dict[str, Method]:
    """Baselines by name.

    Args:
        names: one name, several, or ``all``.
        config: the whole configuration as plain data.
        device: where they run.

    Raises:
        InputError: there is no such baseline, or the renderer does not run on ``device``.
    """
    names = BASELINES if names == "all" else [names] if isinstance(names, str) else names
    renderer = inputs.build_renderer(config, device)

    def untrained() -> GHGS:
        return GHGS.from_config(config).to(device)

    return {name: baseline(name, renderer, untrained, config["per_scene"]) for name in names}


def _methods(
    options: "Evaluate", config: dict[str, Any], device: Any
) -> tuple[dict[str, Method], dict[str, Any]]:
    """The methods to measure by name, and facts about the model.

    Raises:
        InputError: there is neither checkpoint nor baseline, or ``skip.every`` is not 1.
    """
    path = options.checkpoint
    if path is None and not options.baselines:
        raise InputError("checkpoint: expected a checkpoint or baselines=[...]; found neither")
    methods: dict[str, Method] = {}
    facts: dict[str, Any] = {"checkpoint": path}
    if path is not None:
        methods["model"], model_facts = trained_method(options, config, device)
        model = methods["model"].model
        expected = "1: ghgs evaluate measures each subject by itself (skip=temporal is of ghgs predict)"
        require(model.skip.every == 1, "skip.every", expected, model.skip.every)
        facts |= model_facts
    methods |= baselines_of(options.baselines, config, device)
    return methods, facts


def run(options: "Evaluate", cfg: DictConfig) -> None:
    """Measure a checkpoint, baselines or both, and write the results.

    Args:
        options: keys of the verb.
        cfg: the whole configuration that Hydra composed.

    Raises:
        InputError: the configuration, a checkpoint or the data is wrong.
    """
    directory = output_dir()
    config = inputs.with_chosen_targets(resolve(inputs.with_trained_data(cfg)))
    if options.checkpoint is not None:
        config |= inputs.model_of(options.checkpoint, cfg)
    write_config(config, directory)
    L.seed_everything(options.seed, workers=True, verbose=False)
    device = inputs.pick_device(options.device)
    methods, facts = _methods(options, config, device)
    data = inputs.build_data(config)
    for method in methods.values():
        if isinstance(method, ModelMethod):
            inputs.check_size(data, method.model)
    check_evaluation(config, data)
    facts |= {"verb": "evaluate", "choices": inputs.choices()}
    path = measure_and_write(methods, data, config, directory, device, **facts)
    if "model" in methods and (auto := methods["model"].model.auto) is not None:
        rows = (row for row in read_results(path)["rows"] if row["method"] == METHOD)
        print(auto.report(decisions_of(rows)), flush=True)
    announce(path)
