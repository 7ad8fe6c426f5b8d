"""``ghgs train``: train a model, then evaluate it."""

import logging
import os
import time
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lightning.pytorch as L
from hydra.core.hydra_config import HydraConfig
from lightning.fabric.plugins.environments import ClusterEnvironment, LightningEnvironment, SLURMEnvironment
from lightning.pytorch.callbacks import Callback, Checkpoint
from lightning.pytorch.utilities import rank_zero_only
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from ghgs_lit.cli.inputs import build_data, check_size, choices, overrides
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.config.compose import chosen_options, saved_text
from ghgs_lit.config.run import Run
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.measure import ModelMethod
from ghgs_lit.evaluation.report import check_evaluation, format_means, measure_and_write
from ghgs_lit.method.model import GHGS
from ghgs_lit.runs import job
from ghgs_lit.runs.processes import Interrupted, in_srun, interruptible, print_how_to_go_on, settle_rank
from ghgs_lit.runs.results import read_results
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.training import GHGSModule, loggers, start
from ghgs_lit.training.callbacks import TrainingCost
from ghgs_lit.training.checkpoints import AtomicCheckpointIO, StopAtStep
from ghgs_lit.weights import switches
from ghgs_lit.weights.checkpoint import read_config
from ghgs_lit.weights.reading import file_of

if TYPE_CHECKING:
    from ghgs_lit.cli.verb import Training
    from ghgs_lit.cli.verbs import Train


def silence_lightning() -> None:
    """Silence Lightning's log messages, which Hydra would print twice, and warnings that do not apply."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    messages = ("LeafSpec", "smaller than the logging interval", "num_workers", "dataloader is not resumable")
    messages += ("overridden `transfer_batch", "exists and is not empty", "`srun` command is available")
    for message in messages:
        warnings.filterwarnings("ignore", f".*{message}.*")


def prepare_start(run: "Train", module: GHGSModule, directory: Path) -> int | None:
    """Load ``init_from`` or ``resume``.

    Args:
        run: Configuration of the run.
        module: Receives the weights.
        directory: Directory of the run; its ``init_from.txt`` lists what was loaded.

    Returns:
        Step to resume at; None: a new run.

    Raises:
        InputError: Both are given, or the checkpoint does not fit.
    """
    start.check_start(run, directory)
    path = run.init_from
    if path is not None and run.resume is None:
        lines = start.initialize(module.model, path, run.init_strict, run.allow_random_encoder)
        if rank_zero_only.rank == 0:
            print(start.report(lines, path, directory / "init_from.txt"), flush=True)
            if differing := switches.differences(run.plain, read_config(path)):
                print(f"the weights were trained in a different model: {', '.join(differing)}", flush=True)
    return resume_step(run, module)


def resume_step(run: "Training", module: L.LightningModule) -> int | None:
    """Load the weights of ``resume``.

    Args:
        run: Configuration of the run.
        module: Receives the weights.

    Returns:
        Step to resume at; None: a new run.

    Raises:
        InputError: The checkpoint does not fit.
    """
    if run.resume is None:
        return None
    step, changed = start.check_resume(run.resume, module, run.plain)
    if rank_zero_only.rank == 0:
        print("\n".join([f"resume {run.resume}: at step {step}", *changed]), flush=True)
    return step


def build_trainer(run: Run, directory: Path, *further: Callback) -> L.Trainer:
    """Build the Trainer with the configured loggers and callbacks.

    Args:
        run: Run with the groups ``trainer``, ``logger`` and ``callbacks``.
        directory: Directory of the run, below which loggers and callbacks write.
        *further: Callbacks that follow the configured ones, whose state a checkpoint at a signal contains.

    Raises:
        InputError: The Trainer rejects its options.
    """
    logs = [options.build(save_dir=str(directory)) for options in run.logger.values()]
    callbacks = [*(options.build() for options in run.callbacks.values()), *further]
    return run.trainer.build(
        logger=logs or False,
        plugins=[AtomicCheckpointIO(), *environments()],
        callbacks=callbacks,
        default_root_dir=str(directory),
        enable_checkpointing=any(isinstance(c, Checkpoint) for c in callbacks),
        enable_progress_bar=False,
    )


def environments() -> list[ClusterEnvironment]:
    """Cluster plugins of the Trainer in a SLURM job.

    Tasks of ``srun`` are processes of the training; those of a batch script are not.

    Raises:
        InputError: Lightning rejects the options with which ``srun`` was started.
    """
    if "SLURM_NTASKS" not in os.environ or "TORCHELASTIC_RUN_ID" in os.environ:
        return []
    # This package stops, saves and requeues: a checkpoint by Lightning might be saved within a step.
    try:
        return [SLURMEnvironment(auto_requeue=False) if in_srun() else LightningEnvironment()]
    except RuntimeError as error:
        raise InputError(f"trainer: {error}") from None


def run(verb: "Train") -> float | str | None:
    """Train and evaluate a run; in a sweep, unless it is done.

    Returns:
        Mean PSNR of the first protocol in dB; in a sweep ``job.BUSY`` if another process has locked the
        run.

    Raises:
        InputError: The configuration, a checkpoint or the data is wrong.
        Interrupted: By Ctrl-C or SIGTERM.
    """
    job.check_config(verb)
    if job.in_sweep():
        job.check_launcher(verb, HydraConfig.get().runtime.choices["hydra/launcher"])
    named = verb.replace(chosen=chosen_options(verb.plain, HydraConfig.get()))
    return run_job(named, RunDirectory(output_dir()), train)


def run_job(run: "Training", directory: RunDirectory, train: job.Train) -> float | str | None:
    """Train a run, alone or as one of several processes.

    Args:
        run: Configuration of the run.
        directory: Directory of the run.
        train: Trains and evaluates; returns the metric.

    Returns:
        See :func:`ghgs_lit.runs.job.train_once`.

    Raises:
        Interrupted: By Ctrl-C or a signal of a batch system; how to continue is printed.
    """
    is_first = settle_rank(run.trainer) == 0
    try:
        with interruptible():
            return (job.train_once if is_first else job.join_training)(directory, run, train)
    except Interrupted as stop:
        if rank_zero_only.rank == 0:
            place = f"hydra.run.dir={directory.path}"
            if job.in_sweep():
                place = f"hydra.sweep.dir={HydraConfig.get().sweep.dir}"
            print_how_to_go_on(stop, str(directory.path), place)
        raise


def train(run: "Train", directory: Path, stats: dict[str, Any]) -> float | None:
    """Train, save the final weights and evaluate them.

    Args:
        run: Configuration of the run.
        directory: Directory of the run.
        stats: Receives the ``steps`` and ``seconds`` of this training.

    Returns:
        Mean PSNR of the first protocol in dB; None in all processes but the first.

    Raises:
        InputError: The configuration, a checkpoint or the data is wrong.
    """
    if rank_zero_only.rank == 0:
        write_config(run, directory)
    L.seed_everything(run.seed, workers=True, verbose=False)
    data = build_data(run)
    model = GHGS.from_config(run.plain)
    renderer = run.renderer.build()
    losses = run.loss.build()
    data.trains_on_depths &= getattr(losses, "reads_depths", True)  # losses of plug-ins may lack it
    module = GHGSModule(model, renderer, losses, run.optimizer.build(), run.plain, run.token_budgets)
    check_size(data, module.predictor)
    step = prepare_start(run, module, directory)
    if run.feature_cache is not None:  # None for verbs that do not train the whole model
        run.feature_cache.attach(model, data)
    run = start.with_origin(run, model)
    module.config = {**module.config, **run.plain}
    silence_lightning()
    cost = TrainingCost()
    trainer = build_trainer(run, directory, cost, StopAtStep())
    module.metrics = run.metrics.build().to(trainer.strategy.root_device)
    # The last check, because it renders missing images.
    check_evaluation(run, data)
    try:
        fit(trainer, module, data, run.resume, step, stats)
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
        return measure_last(trainer, module, data, run, directory, training)
    finally:
        loggers.close(trainer.loggers)


def fit(
    trainer: L.Trainer,
    module: L.LightningModule,
    data: L.LightningDataModule,
    resume: str | None,
    step: int | None,
    stats: dict[str, Any],
) -> None:
    """Train a module.

    Args:
        trainer: Trains the module.
        module: Already has the weights of ``resume``, if any.
        data: Data of the training.
        resume: Checkpoint to resume from, if any.
        step: Step of that checkpoint; None: a new run.
        stats: Receives ``steps``, those of this call, and ``seconds``, even if training is
            interrupted.

    Raises:
        InputError: Options of the Trainer do not fit the data, or ``resume`` does not fit the optimizer.
    """
    loggers.begin(trainer.loggers, saved_text(module.config), step)
    started = time.perf_counter()
    try:
        trainer.fit(module, data, ckpt_path=resume and file_of(resume))
    except MisconfigurationException as error:  # raised for options that do not fit the data
        raise InputError(f"trainer: {error}") from None
    except Exception as error:
        # Lightning reads the training state, which may be damaged, before it creates data loaders.
        if resume is None or trainer.train_dataloader is not None or isinstance(error, InputError):
            raise
        found = f"{type(error).__name__}: {error}".splitlines()[0]
        raise InputError(f"{resume}: expected the state of a training run; found {found}") from error
    finally:
        stats |= {
            "steps": max(trainer.global_step - (step or 0), 0),
            "seconds": time.perf_counter() - started,
        }


def measure_last(
    trainer: L.Trainer,
    module: GHGSModule,
    data: L.LightningDataModule,
    run: "Train",
    directory: Path,
    training: dict[str, Any],
) -> float:
    """Evaluate the final weights and write the results to disk and to the loggers.

    Args:
        trainer: Trainer that has trained the module.
        module: Its model is evaluated and left in evaluation mode.
        data: Provides the batches of the evaluation.
        run: Configuration of the run.
        directory: Directory of the run.
        training: Facts about the training: ``steps``, ``seconds``, ``peak_bytes``, ``processes``.

    Returns:
        Mean PSNR of the first protocol in dB.
    """
    model = module.model.eval()
    device = trainer.strategy.root_device
    model.to(device)
    identity = RunDirectory(directory).marker
    path = measure_and_write(
        {"model": ModelMethod(module.predictor, module.renderer)},
        data,
        run,
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
    values = loggers.hyperparameters(run.plain, choices(), overrides())
    table = format_means(summary, "github")
    loggers.log_results(trainer.loggers, values, summary, table, trainer.global_step)
    announce(path)
    return summary[0]["psnr"]
