"""What a job of a sweep does: take the run if it is free and not done, and go on where it was cut off."""

import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.errors import InputError
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.runs.run import Run

BUSY = "busy"
"""What a job gives back when another process works on its run."""
SWEEPER = "hydra_plugins.ghgs_lit_sweeper.GridSweeper"
# Set for a job that a sweep starts as a process of its own: "skip" or "wait" when its run is taken.
_VARIABLE = "GHGS_SWEEP_JOB"

Train = Callable[[dict[str, Any], Path, dict[str, Any]], float | None]
"""``(config, directory, notes) -> metric``; the notes go to the session's log."""


def is_multirun() -> bool:
    """Whether Hydra launched this job as one of several."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def in_sweep() -> bool:
    """Whether this process runs a job of a sweep."""
    return is_multirun() or _VARIABLE in os.environ


def _waits() -> bool:
    """The grid comes back to a run that is taken; other sweepers need its result now."""
    if is_multirun():
        return HydraConfig.get().sweeper.get("_target_") != SWEEPER
    return os.environ.get(_VARIABLE) == "wait"


def _hash_of_run(*, _root_: DictConfig) -> str:
    keys = [key for key in _root_ if key != "hydra"]
    return config_hash(OmegaConf.to_container(OmegaConf.masked_copy(_root_, keys), resolve=True))


def _sqlite(path: str) -> str:
    place = Path(path).resolve()
    place.parent.mkdir(parents=True, exist_ok=True)  # SQLite does not
    return f"sqlite:///{place}"


def register_resolvers() -> None:
    """``${config_hash:}``, the name of a job's directory, and ``${sqlite:path}``, the URL of a data base."""
    OmegaConf.register_new_resolver("config_hash", _hash_of_run, replace=True)
    OmegaConf.register_new_resolver("sqlite", _sqlite, replace=True)


def going_on(config: dict[str, Any], run: Run) -> dict[str, Any]:
    """``config`` that resumes from the run's own last checkpoint; in a sweep only."""
    if not in_sweep() or config["resume"] is not None or run.checkpoint is None:
        return config
    return {**config, "resume": str(run.checkpoint)}


def work_on(run: Run, config: dict[str, Any], train: Train) -> float | str | None:
    """Train ``run`` unless it is done or another process does; its metric, or ``BUSY``."""
    with run.claim(wait=_waits()) as mine:
        if not mine and in_sweep():
            print(f"skipped: {run.owner} works on {run.directory}", flush=True)
            return BUSY
        if not mine:
            raise InputError(
                f"{run.directory}: expected a directory that no process works in; found {run.owner}"
            )
        if in_sweep() and run.done:
            print(f"done before: {run.directory}", flush=True)
            return run.metric
        config = going_on(config, run)
        with run.session(resumed=config["resume"]) as notes:
            return train(config, run.directory, notes)


def work_in_own_process(run: Run) -> float | str | None:
    """Run the job as ``ghgs train`` of its own: training in several processes cannot share one with others.

    The new process takes the run, so that it keeps it when this one dies.
    """
    command = [sys.executable, "-m", "ghgs_lit", "train", *HydraConfig.get().overrides.task]
    command += [f"hydra.run.dir='{run.directory}'", "hydra.mode=RUN"]
    mode = {_VARIABLE: "wait" if _waits() else "skip"}
    done = subprocess.run(command, env={**os.environ, **mode}, check=False)
    if done.returncode:
        raise InputError(f"{run.directory}: expected a job that ends well; found exit code {done.returncode}")
    return run.metric if run.done else BUSY


def refuse_shared_process(config: Mapping[str, Any], launcher: str) -> bool:
    """Whether a job of a sweep trains in several processes.

    Raises:
        InputError: it does, and the ``launcher`` runs all jobs in one process.
    """
    devices = config["trainer"].get("devices", 1)
    if devices in (1, "1", [0]):
        return False
    if launcher == "basic":
        raise InputError(
            f"trainer.devices: expected 1 in a sweep whose jobs share a process; found {devices}"
            " (hydra/launcher=joblib, submitit_local or submitit_slurm gives each job its own)"
        )
    return True


def needs_own_process(config: Mapping[str, Any]) -> bool:
    """Whether this job of a sweep trains in several processes that Lightning starts."""
    if not is_multirun():
        return False
    launcher = HydraConfig.get().runtime.choices.get("hydra/launcher", "basic")
    # SLURM starts the processes of a job itself.
    return refuse_shared_process(config, launcher) and "slurm" not in launcher
