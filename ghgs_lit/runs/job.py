"""Jobs that train: lock a run that is free and not done, then train or resume it."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import omegaconf
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.config.compose import plain
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.keys import lookup
from ghgs_lit.config.run import Run
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import read_yaml
from ghgs_lit.runs.processes import is_queued_again, process_count
from ghgs_lit.runs.results import config_hash
from ghgs_lit.runs.run import AUTO, MARKER, PLAN, RunDirectory, begun_by_job

if TYPE_CHECKING:
    from ghgs_lit.cli.verb import Training
    from ghgs_lit.cli.verbs import Train as TrainVerb

BUSY = "busy"  #: Return value of a job whose run another process works on
_PATIENCE = 300.0  # seconds in which the first of several processes begins
_TASK = "hydra.overrides.task"  # key of the overrides of a sweep's command
SWEEPER = "hydra_plugins.ghgs_lit_sweeper.GridSweeper"

Train = Callable[[Run, Path, dict[str, Any]], float | None]
"""``(run, directory, stats) -> metric``; ``stats`` is filled for ``sessions.jsonl``."""


def in_sweep() -> bool:
    """Whether Hydra launched this job as one of several."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def _waits() -> bool:
    """Whether to wait for a locked run: the grid sweeper returns to it later,
    others need its result now."""
    return in_sweep() and HydraConfig.get().sweeper.get("_target_") != SWEEPER


def register_resolvers() -> None:
    """Register resolvers of configurations: ``${config_hash:}``, the name of a run's directory;
    ``${run_of_job:name}``, the name of a directory that a job of SLURM goes on in, else ``name``;
    ``${folder:first,second}``, the second if the first is null."""

    def hash_of_run(*, _root_: DictConfig) -> str:
        keys = [key for key in _root_ if key != "hydra"]
        return config_hash(plain(fill(OmegaConf.masked_copy(_root_, keys))))

    def run_of_job(name: str, *, _root_: DictConfig) -> str:
        if not is_queued_again():
            return name
        runs = Path("runs", _root_.hydra.job.name)
        if name.startswith("sweep_"):
            command = list(_root_.hydra.overrides.task)
            sweeps = {run.path.parent for run in begun_by_job(runs, f"sweep_*/*/{MARKER}")}
            folders = [sweep for sweep in sweeps if lookup(read_yaml(sweep / PLAN), _TASK) == command]
        else:
            own_hash = hash_of_run(_root_=_root_)
            begun = begun_by_job(runs, f"*/{MARKER}")
            folders = [run.path for run in begun if run.marker.config_hash == own_hash]
        return max((path.name for path in folders), default=name)

    def folder(first: str | float | None, second: str) -> str:
        return second if first is None else str(Path(str(first)).expanduser())

    is_old = omegaconf.__version__.startswith("2.3")
    register = OmegaConf.register_new_resolver if is_old else OmegaConf.register_resolver
    resolvers = {"folder": folder, "config_hash": hash_of_run, "run_of_job": run_of_job}
    for name, resolver in resolvers.items():
        register(name, resolver, replace=True)


def train_once(directory: RunDirectory, run: "Training", train: Train) -> float | str | None:
    """Train a run from where it stands, in the process that locks it.

    Args:
        directory: Of the run.
        run: Its configuration.
        train: Trains and measures; returns the metric.

    Returns:
        The metric, also of a run that is done; ``BUSY``: in a sweep, another process works on it.

    Raises:
        InputError: Outside of a sweep, another process works on it; its directory holds another run
            or other files.
    """
    directory = directory.of(run)
    path = directory.path
    with directory.claim(wait=_waits()) as claimed:
        if not claimed and in_sweep():
            print(f"skipped: {directory.owner} works on {path}", flush=True)
            return BUSY
        if not claimed:
            expected = "a directory that no process works in"
            raise InputError(f"{path}: expected {expected}; found {directory.owner}")
        if directory.done and (in_sweep() or directory.goes_on(run)):
            print(f"done before: {path}", flush=True)
            return directory.metric
        run = directory.begin(run)
        with directory.session(run.resume) as stats:
            return train(run, path, stats)


def train_beside(directory: RunDirectory, run: "Training", train: Train) -> float | str | None:
    """Train a run as one of several processes, the first of which is in :func:`train_once`.

    Args:
        directory: Of the run.
        run: Its configuration.
        train: Trains and measures; returns the metric.

    Returns:
        What ``train`` returns, or the metric of a run that is done.

    Raises:
        InputError: There is no first process.
    """
    directory = directory.of(run)
    end = time.monotonic() + _PATIENCE
    while (session := directory.session_beside()) is None:
        if directory.done and (in_sweep() or directory.goes_on(run)):
            return directory.metric
        expected = "the first process of this training to work in it"
        require(time.monotonic() < end, str(directory.path), expected, directory.owner)
        time.sleep(0.2)
    return train(run.replace(resume=session["resumed"]), directory.path, {})


def check_launcher(run: Run, launcher: str) -> None:
    """Check that a job of a sweep can train in several processes, which only SLURM starts.

    Args:
        run: With the group ``trainer``.
        launcher: Chosen option of ``hydra/launcher``.

    Raises:
        InputError: The launcher starts one process, the training wants several.
    """
    fits = "slurm" in launcher or process_count(run.trainer) == 1
    expected = "1 in a sweep, or hydra/launcher=slurm, which starts processes"
    require(fits, "trainer.devices", expected, run.plain["trainer"]["devices"])


def check_config(run: "TrainVerb") -> None:
    """Check that a run can train.

    Args:
        run: Its configuration.

    Raises:
        InputError: It has a frozen encoder without weights.
    """
    if run.init_from is not None or run.resume not in (None, AUTO) or run.allow_random_encoder:
        return
    if getattr(run.encoder, "semantic", None) is not None:  # a plug-in's may have none
        raise InputError(
            "init_from: expected a checkpoint of `ghgs pretext` for encoder.semantic, which does not learn in"
            " training; found none: it would stay random (allow_random_encoder=true to try things out)"
        )
    trainable = getattr(run.encoder, "trainable", "all")
    if trainable in (None, "all"):
        return
    raise InputError(
        f"init_from: expected a checkpoint with the encoder's weights for encoder.trainable={trainable},"
        " such as that of `ghgs import vggt=facebook/VGGT-1B compat=none out=vggt.ckpt`; found none:"
        " the encoder would stay random (allow_random_encoder=true to try things out)"
    )
