"""``ghgs train``: train a model, then measure it."""

import logging
import os
import time
import warnings
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as L
from hydra.core.hydra_config import HydraConfig
from lightning.fabric.plugins.environments import ClusterEnvironment, LightningEnvironment, SLURMEnvironment
from lightning.pytorch.callbacks import Callback, Checkpoint
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from ghgs_lit.cli.inputs import build_data, check_size, choices, given_keys, overrides
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.config import build, resolve
from ghgs_lit.config.compose import chosen_options
from ghgs_lit.config.registry import read_node
from ghgs_lit.errors import InputError, require
from ghgs_lit.evaluation.measure import ModelMethod
from ghgs_lit.evaluation.protocols import check_evaluation
from ghgs_lit.evaluation.report import measure_and_write
from ghgs_lit.model import GHGS
from ghgs_lit.runs import job
from ghgs_lit.runs.processes import in_srun, queue_again, settle_rank
from ghgs_lit.runs.results import read_results
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.runs.signals import Interrupted, interruptible, print_how_to_go_on
from ghgs_lit.training import GHGSModule, loggers, start
from ghgs_lit.training.callbacks import NeighborsAtStart
from ghgs_lit.training.checkpoints import AtomicCheckpointIO, StopAtStep
from ghgs_lit.training.cost import TrainingCost
from ghgs_lit.weights import switches
from ghgs_lit.weights.checkpoint import read_config

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Train


def quiet() -> None:
    """Silence Lightning's log lines, which Hydra would print twice,
    and warnings that do not apply here."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    messages = ("LeafSpec", "smaller than the logging interval", "num_workers", "dataloader is not resumable")
    messages += ("overridden `transfer_batch", "exists and is not empty")
    for message in messages:
        warnings.filterwarnings("ignore", f".*{message}.*")


@cache
def say_which_model() -> None:
    """Print once per process that the default model, unless one was chosen, is not the paper's."""
    chosen = {"model", "experiment", "sweep"} & set(given_keys())
    if choices().get("model") == "hull" and not chosen:
        print("training model=hull, which learns in minutes; model=paper is the paper's method", flush=True)


def prepare_start(config: dict[str, Any], module: GHGSModule, directory: Path) -> int | None:
    """Load ``init_from`` or ``resume``.

    Args:
        config: the whole configuration as plain data.
        module: gets the weights.
        directory: the run's; what was loaded is listed in its ``init_from.txt``.

    Returns:
        The step to resume at; None: a new run.

    Raises:
        InputError: both are given, or the checkpoint does not fit.
    """
    start.check_start(config, directory)
    if config["init_from"] is not None and config["resume"] is None:
        lines = start.initialize(
            module.model, config["init_from"], config["init_strict"], config["allow_random_encoder"]
        )
        if rank_zero_only.rank == 0:
            print(start.report(lines, config["init_from"], directory / "init_from.txt"), flush=True)
            if differing := switches.differences(config, read_config(config["init_from"])):
                print(f"the weights were trained in a different model: {', '.join(differing)}", flush=True)
    return resume_step(config, module)


def resume_step(config: dict[str, Any], module: L.LightningModule) -> int | None:
    """Load the weights of ``resume``.

    Args:
        config: the whole configuration as plain data.
        module: gets the weights.

    Returns:
        The step to resume at; None: a new run.

    Raises:
        InputError: the checkpoint does not fit.
    """
    if config["resume"] is None:
        return None
    step, changed = start.check_resume(config["resume"], module, config)
    if rank_zero_only.rank == 0:
        print("\n".join([f"resume {config['resume']}: at step {step}", *changed]), flush=True)
    return step


def build_trainer(config: dict[str, Any], directory: Path, *further: Callback) -> L.Trainer:
    """The Trainer with the configured loggers and callbacks.

    Args:
        config: the whole configuration as plain data.
        directory: the run's; loggers and callbacks write below it.
        *further: callbacks that come before the configured ones.

    Raises:
        InputError: it refuses its options.
    """
    logs = [build(node, f"logger.{name}", save_dir=str(directory)) for name, node in config["logger"].items()]
    callbacks = [*further, *(build(node, f"callbacks.{name}") for name, node in config["callbacks"].items())]
    return build(
        config["trainer"],
        "trainer",
        logger=logs or False,
        plugins=[AtomicCheckpointIO(), *environments()],
        callbacks=callbacks,
        default_root_dir=str(directory),
        enable_checkpointing=any(isinstance(c, Checkpoint) for c in callbacks),
        enable_progress_bar=False,
    )


def environments() -> list[ClusterEnvironment]:
    """Plugins of the Trainer for a job of SLURM.

    Tasks of ``srun`` are the processes of a training, those of a batch script are not.

    Raises:
        InputError: ``srun`` was asked for other tasks.
    """
    if "SLURM_NTASKS" not in os.environ or "TORCHELASTIC_RUN_ID" in os.environ:
        return []
    # this package stops, saves and queues again: Lightning's own checkpoint may lie within a step
    try:
        return [SLURMEnvironment(auto_requeue=False) if in_srun() else LightningEnvironment()]
    except RuntimeError as error:
        raise InputError(f"trainer: {error}") from None


def run(options: "Train", cfg: DictConfig) -> float | str | None:
    """Train and measure a run; in a sweep unless it is done.

    Args:
        options: keys of the verb.
        cfg: the whole configuration that Hydra composed.

    Returns:
        Mean PSNR of the first protocol in dB; in a sweep ``job.BUSY`` where another process
        works on the run.

    Raises:
        InputError: the configuration, a checkpoint or the data is wrong.
        Interrupted: by Ctrl-C or SIGTERM.
    """
    config = resolve(cfg)
    run_directory = RunDirectory(output_dir())
    config["chosen"] = chosen_options(config, HydraConfig.get())
    require(not options.dry_run, "dry_run", "false without a grid (-m, or sweep=<file>)", True)
    job.check_config(config)
    if job.in_sweep():
        job.check_launcher(config, HydraConfig.get().runtime.choices["hydra/launcher"])
    return run_job(config, run_directory, train)


def run_job(config: dict[str, Any], run_directory: RunDirectory, train: job.Train) -> float | str | None:
    """Train a run, alone or as one of several processes.

    Args:
        config: the whole configuration as plain data.
        run_directory: of the run.
        train: trains and measures; returns the metric.

    Returns:
        As :func:`ghgs_lit.runs.job.train_once`.

    Raises:
        Interrupted: by Ctrl-C or a signal of a batch system; how to go on is printed.
    """
    is_first = settle_rank(config["trainer"]) == 0
    with interruptible():
        try:
            return (job.train_once if is_first else job.train_beside)(run_directory, config, train)
        except Interrupted as stop:
            if rank_zero_only.rank == 0 and not stop.explained:
                place = f"hydra.run.dir={run_directory.path}"
                if job.in_sweep():
                    place = f"hydra.sweep.dir={HydraConfig.get().sweep.dir}"
                print_how_to_go_on(stop, str(run_directory.path), place, queue_again(stop.number))
            raise


def train(config: dict[str, Any], directory: Path, stats: dict[str, Any]) -> float | None:
    """Train, save the last weights and measure them.

    Args:
        config: the whole configuration as plain data.
        directory: the run's.
        stats: receives the ``steps`` and ``seconds`` of this training.

    Returns:
        Mean PSNR of the first protocol in dB; None in all processes but the first.

    Raises:
        InputError: the configuration, a checkpoint or the data is wrong.
    """
    if rank_zero_only.rank == 0:
        write_config(config, directory)
        say_which_model()
    L.seed_everything(config["seed"], workers=True, verbose=False)
    data = build_data(config)
    model = GHGS.from_config(config)
    check_size(data, model)
    renderer = build(config["renderer"], "renderer")
    losses = build(config["loss"], "loss")
    data.trains_on_depths &= getattr(losses, "reads_depths", True)  # a plug-in's may not say
    module = GHGSModule(
        model, renderer, losses, build(config["optimizer"], "optimizer"), config, config.get("token_budgets")
    )
    step = prepare_start(config, module, directory)
    if "feature_cache" in config:  # of verbs that train the whole model
        read_node(config["feature_cache"], "feature_cache").attach(model, data)
    config = start.with_origin(config, model)
    module.config = {**module.config, **config}
    quiet()
    cost = TrainingCost()
    trainer = build_trainer(config, directory, cost, StopAtStep(), NeighborsAtStart())
    module.metrics = build(config["metrics"], "metrics").to(trainer.strategy.root_device)
    # The last check, because it makes missing photographs.
    check_evaluation(config, data)
    try:
        fit(trainer, module, data, config, step, stats)
        checkpoint = directory / "checkpoints" / "last.ckpt"
        trainer.save_checkpoint(checkpoint)
        if not trainer.is_global_zero:
            return None
        training = {
            "steps": trainer.global_step,
            "seconds": cost.seconds,
            "peak_bytes": cost.peak_bytes,
            "processes": trainer.world_size,
        }
        print(f"trained {trainer.global_step} steps in {cost.seconds:.0f} s: {checkpoint}", flush=True)
        return measure_last(trainer, module, data, config, directory, training)
    finally:
        loggers.close(trainer.loggers)


def fit(
    trainer: L.Trainer,
    module: L.LightningModule,
    data: L.LightningDataModule,
    config: dict[str, Any],
    step: int | None,
    stats: dict[str, Any],
) -> None:
    """Train a module.

    Args:
        trainer: trains it.
        module: its weights are those of ``resume``, if any.
        data: of the training.
        config: the whole configuration as plain data; ``resume`` is read.
        step: where ``resume`` stands; None: a new run.
        stats: receives ``steps``, those taken here, and ``seconds``,
            even if training is interrupted.

    Raises:
        InputError: options of the Trainer do not fit the data.
    """
    if step is not None:
        loggers.resume(trainer.loggers, step)
    started = time.perf_counter()
    try:
        trainer.fit(module, data, ckpt_path=config["resume"])
    except MisconfigurationException as error:  # of options that do not fit the data
        raise InputError(f"trainer: {error}") from None
    finally:
        stats |= {
            "steps": max(trainer.global_step - (step or 0), 0),
            "seconds": time.perf_counter() - started,
        }


def measure_last(
    trainer: L.Trainer,
    module: GHGSModule,
    data: L.LightningDataModule,
    config: dict[str, Any],
    directory: Path,
    training: dict[str, Any],
) -> float:
    """Measure the last weights and write the results, on disk and to the loggers.

    Args:
        trainer: has trained the module.
        module: its model is measured, and put into evaluation mode.
        data: gives the batches of the evaluation.
        config: the whole configuration as plain data.
        directory: the run's.
        training: facts about the training: ``steps``, ``seconds``, ``peak_bytes``, ``processes``.

    Returns:
        Mean PSNR of the first protocol in dB.
    """
    model = module.model
    device = trainer.strategy.root_device
    identity = RunDirectory(directory).marker
    path = measure_and_write(
        {"model": ModelMethod(model.to(device).eval(), module.renderer)},
        data,
        config,
        directory,
        device,
        verb="train",
        choices=choices(),
        checkpoint="checkpoints/last.ckpt",
        parameters={
            "total": sum(p.numel() for p in model.parameters()),
            "trained": sum(p.numel() for p in model.parameters() if p.requires_grad),
        },
        training=training,
        run=identity and {"id": identity.id, "config_hash": identity.config_hash},
        sessions=RunDirectory(directory).sessions(),
    )
    summary = read_results(path)["summary"]
    changes = RunDirectory(directory).swept or overrides()
    values = loggers.hyperparameters(config, choices(), changes)
    loggers.log_results(trainer.loggers, values, summary, trainer.global_step)
    announce(path)
    return summary[0]["psnr"]
