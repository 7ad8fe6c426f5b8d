"""What the verbs that measure begin with: data, device, and what the user chose."""

from collections.abc import Mapping
from typing import Any

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.config import build
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.model import GHGS
from ghgs_lit.weights.checkpoint import read_checkpoint


def build_data(config: Mapping[str, Any]) -> PhotographsDataModule:
    """The configured data with its view and target protocols."""
    return build(
        config["data"], "data", views=config["views"], targets=config["targets"], seed=config["seed"]
    )


def check_size(data: PhotographsDataModule, model: GHGS) -> None:
    """Refuse photographs that ``model`` cannot take, before any of them is made or read.

    Raises:
        InputError: their sides are not divisible by the model's patch.
    """
    size, multiple = data.options.size, model.side_multiple
    expected = f"sides divisible by the patch size {multiple} (or model.pad=multiple)"
    require(not any(side % multiple for side in size), "data.size", expected, list(size))


def with_trained_data(cfg: DictConfig) -> DictConfig:
    """``cfg`` with the data that its checkpoint was trained on, where no ``data`` was chosen.

    A checkpoint of somebody else does not say where this machine writes: ``data.cache_dir`` is the default.

    Raises:
        InputError: there is no checkpoint, or it was not trained.
    """
    if cfg.get("data") is not None:
        return cfg
    if cfg.checkpoint is None:
        raise InputError("data: expected data=... where there is no checkpoint; found none")
    trained = read_checkpoint(cfg.checkpoint)["config"]
    if "data" not in trained:
        raise InputError(
            f"data: expected data=... for weights that were imported ({cfg.checkpoint}); found none"
        )
    data = {key: None if key == "cache_dir" else value for key, value in trained["data"].items()}
    return OmegaConf.merge({"data": data}, cfg)


def pick_device(name: str) -> torch.device:
    """The device ``cpu`` or ``cuda``; CUDA for ``auto``, and the CPU where there is no CUDA."""
    choice("device", name, ("auto", "cpu", "cuda"))
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")


def choices() -> dict[str, str]:
    """The option of each config group in this run; empty outside of Hydra."""
    return dict(HydraConfig.get().runtime.choices) if HydraConfig.initialized() else {}


def overrides() -> list[str]:
    """What the command line or the sweep changed in this run; empty outside of Hydra."""
    return list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []
