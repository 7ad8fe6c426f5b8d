"""What the verbs that measure have in common: data, methods, results in the run's directory."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import rich
import torch
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch import LightningDataModule
from omegaconf import DictConfig, OmegaConf
from rich.table import Table

from ghgs_lit.config import build
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.evaluation.measure import Method, measure_all
from ghgs_lit.runs.provenance import provenance
from ghgs_lit.runs.results import Row, metric_names, summarize, write_results
from ghgs_lit.weights.checkpoint import read_checkpoint

# What is printed, with its decimals.
PRINTED = {"psnr": 2, "psnr_box": 2, "ssim": 4, "lpips": 4, "flip": 4, "depth_error_mm": 1}
DEVICES = ("auto", "cpu", "cuda")
SPLITS = {
    "train": "the subjects that were trained on",
    "val": "unseen in training; validation shares them: it chooses best.ckpt, and never last.ckpt",
}
"""What a reader of numbers has to know about the subjects that they are of."""


def build_data(config: Mapping[str, Any]) -> LightningDataModule:
    """The configured data with its view and target protocols."""
    return build(
        config["data"], "data", views=config["views"], targets=config["targets"], seed=config["seed"]
    )


def with_trained_data(cfg: DictConfig) -> DictConfig:
    """``cfg`` with the data that its checkpoint was trained on, where no ``data`` was chosen."""
    if cfg.get("data") is not None:
        return cfg
    if cfg.checkpoint is None:
        raise InputError("data: expected data=... where there is no checkpoint; found none")
    trained = read_checkpoint(cfg.checkpoint)["config"]
    if "data" not in trained:
        raise InputError(
            f"data: expected data=... for weights that were imported ({cfg.checkpoint}); found none"
        )
    return OmegaConf.merge({"data": trained["data"]}, cfg)


def pick_device(name: str) -> torch.device:
    """``auto`` is CUDA where there is one."""
    choice("device", name, DEVICES)
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def choices() -> dict[str, str]:
    """Which member of each config group this run was made of; empty outside of Hydra."""
    return dict(HydraConfig.get().runtime.choices) if HydraConfig.initialized() else {}


def overrides() -> list[str]:
    """What the command line, or the sweep, changed in this run; empty outside of Hydra."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []


def measure_and_write(
    methods: Mapping[str, Method],
    data: LightningDataModule,
    config: Mapping[str, Any],
    directory: Path,
    device: torch.device,
    **facts: Any,
) -> Path:
    """Measure ``methods`` as ``config`` (``evaluation``, ``metrics``) says; print and write the results."""
    protocol = config["evaluation"]
    for key in ("views", "targets"):
        found = protocol[key]
        require(isinstance(found, list) and bool(found), f"evaluation.{key}", "a list with a value", found)
    metrics = build(config["metrics"], "metrics").to(device)
    for name, reason in metrics.left_out.items():
        print(f"{name} is left out: {reason}", flush=True)
    rows = measure_all(
        dict(methods),
        data,
        views=protocol["views"],
        targets=protocol["targets"],
        split=protocol["split"],
        metrics=metrics,
        device=device,
        pictures=directory / "pictures",
        picture_count=protocol["pictures"],
    )
    source = provenance(
        config,
        seed=config["seed"],
        data={"name": config["data"].get("name"), "split": protocol["split"]},
        protocol={
            "metrics": metrics.protocol,
            "views": list(protocol["views"]),
            "targets": list(protocol["targets"]),
            "reported": list(metrics.metrics),
            "left_out": metrics.left_out,
            "definitions": metrics.definitions,
            "split": SPLITS.get(protocol["split"], "unseen in training"),
        },
        choices=choices(),
        **facts,
    )
    print_summary(rows)
    return write_results(directory, rows, source)


def print_summary(rows: list[Row]) -> None:
    """Means over subjects as a table on the terminal; the files have all numbers."""
    names = [name for name in PRINTED if name in metric_names(rows)]
    table = Table("method", "views", "targets", *names)
    for mean in summarize(rows):
        numbers = ("-" if mean[n] is None else f"{mean[n]:.{PRINTED[n]}f}" for n in names)
        table.add_row(mean["method"], str(mean["views"]), mean["targets"], *numbers)
    rich.print(table)
