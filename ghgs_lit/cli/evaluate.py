"""``ghgs evaluate``: measure a checkpoint, baselines, or both on the same targets."""

from typing import Any

import lightning.pytorch as L
from omegaconf import DictConfig

from ghgs_lit.cli.inputs import (
    build_data,
    check_size,
    choices,
    model_of,
    pick_device,
    with_chosen_targets,
    with_trained_data,
)
from ghgs_lit.cli.methods import baselines_of, trained_method
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.config import resolve
from ghgs_lit.encoder import FeatureCacheOptions
from ghgs_lit.errors import InputError, require
from ghgs_lit.evaluation.check import check_evaluation
from ghgs_lit.evaluation.measure import Method, ModelMethod, decisions_of
from ghgs_lit.evaluation.report import measure_and_write
from ghgs_lit.runs.results import METHOD, read_results


def _methods(config: dict[str, Any], device: Any) -> tuple[dict[str, Method], dict[str, Any]]:
    """The methods to measure by name, and facts about them for the results."""
    path = config["checkpoint"]
    if path is None and not config["baselines"]:
        raise InputError("checkpoint: expected a checkpoint or baselines=[...]; found neither")
    methods: dict[str, Method] = {}
    facts: dict[str, Any] = {"checkpoint": path}
    if path is not None:
        methods["model"], found = trained_method(config, device)
        model = methods["model"].model
        expected = "1: ghgs evaluate measures each subject by itself (skip=temporal is of ghgs predict)"
        require(model.skip.every == 1, "skip.every", expected, model.skip.every)
        model.feature_cache = FeatureCacheOptions.read(config["feature_cache"], "feature_cache").build(
            model.recalibration.tokens
        )
        facts |= found
    methods |= baselines_of(config["baselines"], config, device)
    return methods, facts


def run(cfg: DictConfig) -> None:
    """The verb; prints the path of the results last."""
    directory = output_dir()
    config = with_chosen_targets(resolve(with_trained_data(cfg)))
    if config["checkpoint"] is not None:
        config |= model_of(config["checkpoint"], cfg)
    write_config(config, directory)
    L.seed_everything(config["seed"], workers=True, verbose=False)
    device = pick_device(config["device"])
    methods, facts = _methods(config, device)
    cache = methods["model"].model.feature_cache if "model" in methods else None
    data = build_data(config)
    for method in methods.values():
        if isinstance(method, ModelMethod):
            check_size(data, method.model)
    check_evaluation(config, data)
    facts |= {"verb": "evaluate", "choices": choices()}
    path = measure_and_write(methods, data, config, directory, device, **facts)
    if cache is not None:
        print(cache.report(), flush=True)
    if "model" in methods and (auto := methods["model"].model.auto) is not None:
        rows = (row for row in read_results(path)["rows"] if row["method"] == METHOD)
        print(auto.report(decisions_of(rows)), flush=True)
    announce(path)
