"""``ghgs train``: train a model, then measure it."""

import logging
import time
import warnings
from pathlib import Path
from typing import Any

import lightning.pytorch as L
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from ghgs_lit.cli.runtime import announce, output_dir, plain, write_config
from ghgs_lit.config import build
from ghgs_lit.encoder import open_cache
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.measure import ModelMethod
from ghgs_lit.evaluation.session import build_data, choices, measure_and_write, overrides
from ghgs_lit.model import GHGS
from ghgs_lit.runs.job import going_on, in_sweep, needs_own_process, work_in_own_process, work_on
from ghgs_lit.runs.plan import print_single_plan
from ghgs_lit.runs.results import read_results
from ghgs_lit.runs.run import Run
from ghgs_lit.training import GHGSModule, loggers, start
from ghgs_lit.training.checkpoints import WholeFiles


def _quiet() -> None:
    """Lightning's own lines come twice under Hydra; these warnings do not hold here."""
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    messages = ("LeafSpec", "smaller than the logging interval", "num_workers", "dataloader is not resumable")
    for message in (*messages, "The dirpath has changed"):
        warnings.filterwarnings("ignore", f".*{message}.*")


def prepare_start(config: dict[str, Any], model: GHGS, directory: Path) -> int | None:
    """Load ``init_from``, check ``resume``; gives the step to resume at, if any."""
    start.check_start(config, directory)
    if config["init_from"] is not None and config["resume"] is None:
        lines = start.initialize(model, config["init_from"], config["init_strict"])
        if rank_zero_only.rank == 0:
            print(start.report(lines, config["init_from"], directory / "init_from.txt"), flush=True)
            if start.switched(config):
                print(f"the weights knew another model: {', '.join(start.switched(config))}", flush=True)
    if config["resume"] is None:
        return None
    step, changed = start.check_resume(config["resume"], model, config)
    if rank_zero_only.rank == 0:
        print("\n".join([f"resume {config['resume']}: at step {step}", *changed]), flush=True)
    return step


def build_trainer(config: dict[str, Any], directory: Path) -> L.Trainer:
    """The Trainer with its loggers and callbacks, all writing below ``directory``."""
    built = [
        build(node, f"logger.{name}", save_dir=str(directory)) for name, node in config["logger"].items()
    ]
    callbacks = [build(node, f"callbacks.{name}") for name, node in config["callbacks"].items()]
    partial = build({**config["trainer"], "_partial_": True}, "trainer")
    try:
        return partial(
            logger=built or False,
            plugins=[WholeFiles()],
            callbacks=callbacks,
            default_root_dir=str(directory),
            enable_checkpointing=any(isinstance(c, L.callbacks.ModelCheckpoint) for c in callbacks),
            enable_progress_bar=any(isinstance(c, L.callbacks.ProgressBar) for c in callbacks),
        )
    except (MisconfigurationException, TypeError, ValueError) as error:
        raise InputError(f"trainer: {error}") from None


def run(cfg: DictConfig) -> float | str | None:
    """Train and measure, or in a sweep whatever its run still lacks; gives the mean PSNR."""
    config, mine = plain(cfg), Run(output_dir())
    if config["dry_run"]:
        return print_single_plan(config, mine)
    if needs_own_process(config):
        return work_in_own_process(mine)
    if rank_zero_only.rank == 0:
        return work_on(mine, config, train)
    # The first process has taken the run for all.
    return None if in_sweep() and mine.done else train(going_on(config, mine), mine.directory, {})


def train(config: dict[str, Any], directory: Path, notes: dict[str, Any]) -> float | None:
    """Train, keep the last weights, measure them; gives the mean PSNR of the first protocol.

    ``notes`` gets the steps and seconds that were trained here.
    """
    if rank_zero_only.rank == 0:
        write_config(config, directory)
    L.seed_everything(config["seed"], workers=True, verbose=False)
    data = build_data(config)
    model = GHGS.from_config(config)
    model.feature_cache = open_cache(config.get("feature_cache"), model.recalibration.tokens)
    step = prepare_start(config, model, directory)
    config = start.with_origin(config, model)
    renderer = build(config["renderer"], "renderer")
    module = GHGSModule(
        model, renderer, build(config["loss"], "loss"), build(config["optimizer"], "optimizer"), config
    )
    _quiet()
    trainer = build_trainer(config, directory)
    if step is not None:
        loggers.go_on(trainer.loggers, step)
    loggers.log_hyperparameters(trainer.loggers, loggers.hyperparameters(config, choices(), overrides()))
    device = trainer.strategy.root_device
    started = time.perf_counter()
    trainer.fit(module, data, ckpt_path=config["resume"])
    seconds = time.perf_counter() - started
    if trainer.interrupted:
        raise KeyboardInterrupt
    notes |= {"steps": trainer.global_step - (step or 0), "seconds": seconds}
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
        sessions=Run(directory).sessions(),
    )
    summary = read_results(path)["summary"]
    loggers.log_results(trainer.loggers, summary, trainer.global_step)
    announce(path)
    return summary[0]["psnr"]
