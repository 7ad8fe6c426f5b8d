"""Training jobs: lock a run that is free and unfinished, then train or resume it."""

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import omegaconf
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.config.compose import to_plain
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.keys import is_hyperparameter, key_of, lookup
from ghgs_lit.config.run import Run
from ghgs_lit.errors import InputError, require
from ghgs_lit.parsing import read_yaml
from ghgs_lit.runs.processes import is_queued_again, process_count
from ghgs_lit.runs.results import config_hash
from ghgs_lit.runs.run import AUTO, CURVES, MARKER, PLAN, RunDirectory, find_runs_of_job

BUSY = "busy"  #: Return value of a job whose run is locked by another process
_PATIENCE = 300.0  # seconds to wait for the first of several processes to begin
_TASK = "hydra.overrides.task"  # key of a sweep's command-line overrides in its multirun.yaml

Train = Callable[[Run, Path, dict[str, Any]], float | None]
"""Function ``(run, directory, stats) -> metric``; it fills ``stats`` for ``run.json``."""


def in_sweep() -> bool:
    """Whether Hydra launched this job as part of a multirun."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def find_curves(directory: Path) -> Path:
    """Folder of a run's TensorBoard files, ``tensorboard`` or, in a sweep, a folder in it. Its name,
    which TensorBoard shows, is made of the overrides that distinguish the run from the others.

    Args:
        directory: Directory of the run.

    Returns:
        The folder in which the run's files are, if any, whatever the sweep's present command.
    """
    folder = directory / "tensorboard"
    begun = [path.parent for pattern in CURVES for path in directory.glob(pattern)]
    if begun or not in_sweep():
        return begun[0] if begun else folder
    hydra = HydraConfig.get()
    shared = _overrides_of(Path(hydra.sweep.dir))
    changes = [text for text in hydra.overrides.task if text not in shared]
    changes = [text for text in changes if is_hyperparameter(key_of(text))]
    return folder / ",".join(changes).replace(os.sep, "_")[-200:]


def _overrides_of(sweep: Path) -> list[str]:
    """Command-line overrides of a sweep's last command; empty if its sweeper writes no ``multirun.yaml``."""
    plan = sweep / PLAN
    return lookup(read_yaml(plan), _TASK) if plan.is_file() else []


def register_resolvers() -> None:
    """Register the resolvers used in configurations.

    - ``${config_hash:}``: name of a run's directory.
    - ``${run_of_job:name}``: the directory that a requeued SLURM job continues in; otherwise ``name``.
    - ``${folder:first,second}``: ``first``, or ``second`` if it is null.
    """

    def hash_of_run(*, _root_: DictConfig) -> str:
        keys = [key for key in _root_ if key != "hydra"]
        return config_hash(to_plain(fill(OmegaConf.masked_copy(_root_, keys))))

    def run_of_job(name: str, *, _root_: DictConfig) -> str:
        if not is_queued_again():
            return name
        # Kept for the jobs of a sweep, whose overrides differ from those of its command.
        found = OmegaConf.get_cache(_root_)["run_of_job"]
        if name in found:
            return found[name]
        runs = Path("runs", _root_.hydra.job.name)
        if name.startswith("sweep_"):
            command = list(_root_.hydra.overrides.task)
            sweeps = {run.path.parent for run in find_runs_of_job(runs, f"sweep_*/*/{MARKER}")}
            folders = [sweep for sweep in sweeps if _overrides_of(sweep) == command]
        else:
            own_hash = hash_of_run(_root_=_root_)
            begun = find_runs_of_job(runs, f"*/{MARKER}")
            folders = [run.path for run in begun if run.marker.config_hash == own_hash]
        found[name] = max((path.name for path in folders), default=name)
        return found[name]

    def folder(first: str | float | None, second: str) -> str:
        return second if first is None else str(Path(str(first)).expanduser())

    is_old = omegaconf.__version__.startswith("2.3")
    register = OmegaConf.register_new_resolver if is_old else OmegaConf.register_resolver
    resolvers = {"folder": folder, "config_hash": hash_of_run, "run_of_job": run_of_job}
    for name, resolver in resolvers.items():
        register(name, resolver, replace=True)


def train_once(directory: RunDirectory, run: Run, train: Train) -> float | str | None:
    """Train a run, resuming it where it stands, in the process that locks it.

    Args:
        directory: Directory of the run.
        run: Configuration of the run.
        train: Trains and evaluates; returns the metric.

    Returns:
        The metric, also of a run that had finished before; in a sweep ``BUSY`` if another process has
        locked the run.

    Raises:
        InputError: Outside a sweep, another process has locked the run; or the directory holds another
            run or foreign files.
    """
    directory = directory.of(run)
    path = directory.path
    with directory.claim() as claimed:
        if not claimed and in_sweep():
            print(f"skipped: {directory.owner} works on {path}", flush=True)
            return BUSY
        if not claimed:
            expected = "a directory that no process works in"
            raise InputError(f"{path}: expected {expected}; found {directory.owner}")
        if directory.done and (in_sweep() or directory.continues(run)):
            print(f"done before: {path}", flush=True)
            return directory.metric
        run = directory.begin(run)
        with directory.session(run.resume) as stats:
            return train(run, path, stats)


def join_training(directory: RunDirectory, run: Run, train: Train) -> float | str | None:
    """Train a run in a further process of a training whose first process is in :func:`train_once`.

    Args:
        directory: Directory of the run.
        run: Configuration of the run.
        train: Trains and evaluates; returns the metric.

    Returns:
        The result of ``train``, or the metric of a run that had finished before.

    Raises:
        InputError: No first process has begun within 300 s.
    """
    directory = directory.of(run)
    end = time.monotonic() + _PATIENCE
    while (session := directory.find_first_session()) is None:
        if directory.done and (in_sweep() or directory.continues(run)):
            return directory.metric
        expected = "the first process of this training to work in it"
        require(time.monotonic() < end, str(directory.path), expected, directory.owner)
        time.sleep(0.2)
    return train(run.replace(resume=session["resumed"]), directory.path, {})


def check_launcher(run: Run, launcher: str) -> None:
    """Check that a sweep's launcher can start as many processes as a run trains with.

    Args:
        run: A run with the group ``trainer``.
        launcher: Chosen option of ``hydra/launcher``.

    Raises:
        InputError: The training requires several processes, which only SLURM launchers start.
    """
    fits = "slurm" in launcher or process_count(run.trainer) == 1
    expected = "1 in a sweep, or hydra/launcher=slurm, which starts processes"
    require(fits, "trainer.devices", expected, run.plain["trainer"]["devices"])


def check_config(run: Run) -> None:
    """Check that a run can train.

    Raises:
        InputError: A frozen encoder, or the semantic branch, has no weights.
    """
    if run.init_from is not None or run.resume not in (None, AUTO) or run.allow_random_encoder:
        return
    if getattr(run.encoder, "semantic", None) is not None:  # encoders of plug-ins may lack it
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
