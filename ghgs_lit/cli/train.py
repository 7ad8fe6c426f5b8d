"""``ghgs train``: train a model, then measure it."""

import logging
import time
import warnings
from pathlib import Path
from typing import Any

import lightning.pytorch as L
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from ghgs_lit.cli.runtime import announce, output_dir, plain, save_config
from ghgs_lit.config import build
from ghgs_lit.errors import InputError
from ghgs_lit.experiments.evaluation import ModelMethod
from ghgs_lit.experiments.results import read_results
from ghgs_lit.experiments.session import build_data, measure_and_write
from ghgs_lit.model import GHGS, read_checkpoint
from ghgs_lit.training import GHGSModule


def _refuse_processes_in_multirun(config: dict[str, Any]) -> None:
    """A sweep's jobs share one process: the other processes of a DDP job would start the sweep again."""
    multirun = HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN
    devices = config["trainer"].get("devices", 1)
    if (
        multirun
        and devices not in (1, "1", [0])
        and "basic" in HydraConfig.get().runtime.choices.get("hydra/launcher", "basic")
    ):
        raise InputError(
            f"trainer.devices: expected 1 in a sweep whose jobs share a process; found {devices}"
        )


def _quiet() -> None:
    """Lightning's own lines come twice under Hydra; these warnings do not hold here."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    messages = ("LeafSpec", "smaller than the logging interval", "num_workers", "dataloader is not resumable")
    for message in (*messages, "The dirpath has changed"):
        warnings.filterwarnings("ignore", f".*{message}.*")


def build_trainer(config: dict[str, Any], directory: Path) -> L.Trainer:
    """The Trainer with its loggers and callbacks, all writing below ``directory``."""
    loggers = [
        build(node, f"logger.{name}", save_dir=str(directory)) for name, node in config["logger"].items()
    ]
    callbacks = [build(node, f"callbacks.{name}") for name, node in config["callbacks"].items()]
    partial = build({**config["trainer"], "_partial_": True}, "trainer")
    try:
        return partial(
            logger=loggers or False,
            callbacks=callbacks,
            default_root_dir=str(directory),
            enable_checkpointing=any(isinstance(c, L.callbacks.ModelCheckpoint) for c in callbacks),
            enable_progress_bar=any(isinstance(c, L.callbacks.ProgressBar) for c in callbacks),
        )
    except (MisconfigurationException, TypeError, ValueError) as error:
        raise InputError(f"trainer: {error}") from None


def run(cfg: DictConfig) -> float | None:
    """Train, keep the last weights, measure them; gives the mean PSNR of the first protocol."""
    directory = output_dir()
    is_first = rank_zero_only.rank == 0
    config = save_config(cfg, directory) if is_first else plain(cfg)
    _refuse_processes_in_multirun(config)
    L.seed_everything(config["seed"], workers=True, verbose=False)
    if config["resume"] is not None:
        read_checkpoint(config["resume"])  # refuses what is missing, foreign, or no plain data
    data = build_data(config)
    model = GHGS.from_config(config)
    renderer = build(config["renderer"], "renderer")
    module = GHGSModule(
        model, renderer, build(config["loss"], "loss"), build(config["optimizer"], "optimizer"), config
    )
    _quiet()
    trainer = build_trainer(config, directory)
    device = trainer.strategy.root_device
    started = time.perf_counter()
    trainer.fit(module, data, ckpt_path=config["resume"])
    seconds = time.perf_counter() - started
    if trainer.interrupted:
        raise KeyboardInterrupt
    checkpoint = directory / "checkpoints" / "last.ckpt"
    trainer.save_checkpoint(checkpoint)
    if not trainer.is_global_zero:
        return None
    print(f"trained {trainer.global_step} steps in {seconds:.0f} s: {checkpoint}", flush=True)
    path = measure_and_write(
        {"model": ModelMethod(model.to(device).eval(), renderer)},
        data,
        config,
        directory,
        device,
        verb="train",
        checkpoint=str(checkpoint.relative_to(directory)),
        parameters={
            "total": sum(p.numel() for p in model.parameters()),
            "trained": sum(p.numel() for p in model.parameters() if p.requires_grad),
        },
        training={"steps": trainer.global_step, "seconds": seconds, "processes": trainer.world_size},
    )
    announce(path)
    return read_results(path)["summary"][0]["psnr"]
