"""``ghgs benchmark task=peers``: a model beside what a user would pick instead."""

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from ghgs_lit.cli.inputs import build_data, check_size, model_of
from ghgs_lit.cli.methods import baselines_of, trained_method
from ghgs_lit.config import build
from ghgs_lit.config.keys import is_below
from ghgs_lit.diagnostics.benchmark.peers import measure_peers, peer_rows
from ghgs_lit.evaluation.check import check_evaluation
from ghgs_lit.evaluation.protocols import target_protocols
from ghgs_lit.runs.journal import Journal
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.runs.results import METHOD
from ghgs_lit.weights.hub import sha256
from ghgs_lit.weights.reading import file_of

#: What the rows of a subject do not depend on: a second run may ask for more of these.
_ASKED = ("baselines", "subjects", "timing", "presets", "scaling")


def peers(cfg: DictConfig, config: dict[str, Any], directory: Path, device: torch.device) -> dict[str, Any]:
    """Measure, or go on where an earlier run in ``directory`` stopped; returns the content of the results."""
    evaluation = {**config["evaluation"], "split": config["split"]}
    config = {**config, **model_of(config["checkpoint"], cfg), "evaluation": evaluation}
    data, (model, _) = build_data(config), trained_method(config, device)
    check_size(data, model.model)
    methods = {METHOD: model, **baselines_of(config["baselines"], config, device)}
    check_evaluation(config, data)
    rows = measure_peers(
        methods,
        data,
        evaluation["views"],
        target_protocols(config),
        config["split"],
        config["subjects"],
        build(config["metrics"], "metrics").to(device),
        device,
        Journal(directory / "subjects.jsonl"),
        _identity(config),
    )
    number, size = len({row["subject"] for row in rows}), " x ".join(map(str, data.dataset.size))
    known = {**data.facts, **data.dataset.split_facts(config["split"])}
    facts = ", ".join(f"{key} {value}" for key, value in known.items() if key != "name")
    about = f"{config['checkpoint']}; {number} subjects of {config['data']['name']}, {size} ({facts})"
    return {"about": about, "random_weights": False, "rows": peer_rows(rows), "broken": [], "subjects": rows}


def _identity(config: dict[str, Any]) -> str:
    """Of configuration and weights."""
    rest = {key: value for key, value in config.items() if not is_below(key, (*_ASKED, "evaluation"))}
    rest["evaluation"] = {"targets": config["evaluation"]["targets"], "split": config["split"]}
    return f"{config_hash(rest)}-{sha256(file_of(config['checkpoint']))[:12]}"
