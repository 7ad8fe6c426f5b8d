"""What a job of a sweep does: lock its run if that is free and not done, and train or resume it."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import omegaconf
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.errors import InputError, require
from ghgs_lit.runs.checks import check_directory
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.runs.run import RunDirectory

BUSY = "busy"
"""The return value of a job whose run another process works on."""
SWEEPER = "hydra_plugins.ghgs_lit_sweeper.GridSweeper"

Train = Callable[[dict[str, Any], Path, dict[str, Any]], float | None]
"""``(config, directory, stats) -> metric``; ``stats`` is filled for ``sessions.jsonl``."""


def is_multirun() -> bool:
    """Whether Hydra launched this job as one of several."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def _waits() -> bool:
    """Whether to wait for a locked run: the grid returns to it later, other sweepers need its result now."""
    return is_multirun() and HydraConfig.get().sweeper.get("_target_") != SWEEPER


def _hash_of_run(*, _root_: DictConfig) -> str:
    keys = [key for key in _root_ if key != "hydra"]
    return config_hash(OmegaConf.to_container(OmegaConf.masked_copy(_root_, keys), resolve=True))


def _sqlite(path: str) -> str:
    place = Path(path).resolve()
    place.parent.mkdir(parents=True, exist_ok=True)  # SQLite does not
    return f"sqlite:///{place}"


def _folder(first: str | None, second: str) -> str:
    return second if first is None else str(Path(first).expanduser())


def register_resolvers() -> None:
    """Register what configurations may ask for.

    ``${config_hash:}`` is a run's directory, ``${sqlite:path}`` a database's URL, ``${folder:first,second}``
    the first of two folders, or the second where that is null.
    """
    is_old = omegaconf.__version__.startswith("2.3")
    register = OmegaConf.register_new_resolver if is_old else OmegaConf.register_resolver
    register("folder", _folder, replace=True)
    register("config_hash", _hash_of_run, replace=True)
    register("sqlite", _sqlite, replace=True)


def with_resume(config: dict[str, Any], run: RunDirectory) -> dict[str, Any]:
    """``config`` that, in a sweep, resumes from the run's own last checkpoint."""
    if not is_multirun() or config["resume"] is not None or run.checkpoint is None:
        return config
    return {**config, "resume": str(run.checkpoint)}


def train_once(run: RunDirectory, config: dict[str, Any], train: Train) -> float | str | None:
    """Train ``run`` unless it is done; returns its metric, or ``BUSY`` if another process works on it."""
    with run.claim(wait=_waits()) as claimed:
        if not claimed and is_multirun():
            print(f"skipped: {run.owner} works on {run.path}", flush=True)
            return BUSY
        if not claimed:
            raise InputError(f"{run.path}: expected a directory that no process works in; found {run.owner}")
        if is_multirun() and run.done:
            print(f"done before: {run.path}", flush=True)
            return run.metric
        config = with_resume(config, run)
        if not is_multirun():
            check_directory(run.path, config)
        with run.session(resumed=config["resume"]) as stats:
            return train(config, run.path, stats)


def refuse_several_processes(config: Mapping[str, Any], launcher: str) -> None:
    """Refuse a job of a sweep that trains in several processes, which only SLURM can start. InputError: it
    does, and the launcher is another one."""
    devices = config["trainer"].get("devices", 1)
    alone = devices in (1, "1", [0]) or "slurm" in launcher
    require(alone, "trainer.devices", "1 in a sweep without SLURM (hydra/launcher=slurm)", devices)
