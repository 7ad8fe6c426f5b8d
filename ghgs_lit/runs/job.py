"""Jobs that train: lock a run that is free and not done, then train or resume it."""

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import omegaconf
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from ghgs_lit.config.keys import lookup
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import resolved
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.runs.run import RunDirectory

BUSY = "busy"  #: Return value of a job whose run another process works on
SWEEPER = "hydra_plugins.ghgs_lit_sweeper.GridSweeper"

Train = Callable[[dict[str, Any], Path, dict[str, Any]], float | None]
"""``(config, directory, stats) -> metric``; ``stats`` is filled for ``sessions.jsonl``."""


def in_sweep() -> bool:
    """Whether Hydra launched this job as one of several."""
    return HydraConfig.initialized() and HydraConfig.get().mode == RunMode.MULTIRUN


def _waits() -> bool:
    """Whether to wait for a locked run: the grid sweeper returns to it later, others need its result now."""
    return in_sweep() and HydraConfig.get().sweeper.get("_target_") != SWEEPER


def register_resolvers() -> None:
    """Register resolvers of configurations: ``${config_hash:}``, the name of a run's directory;
    ``${sqlite:path}``, a database's URL; ``${folder:first,second}``, the second if the first is null."""

    def hash_of_run(*, _root_: DictConfig) -> str:
        keys = [key for key in _root_ if key != "hydra"]
        return config_hash(OmegaConf.to_container(OmegaConf.masked_copy(_root_, keys), resolve=True))

    def sqlite(path: str) -> str:
        place = Path(path).resolve()
        place.parent.mkdir(parents=True, exist_ok=True)  # SQLite does not
        return f"sqlite:///{place}"

    def folder(first: str | None, second: str) -> str:
        return second if first is None else str(Path(first).expanduser())

    is_old = omegaconf.__version__.startswith("2.3")
    register = OmegaConf.register_new_resolver if is_old else OmegaConf.register_resolver
    for name, resolver in (("folder", folder), ("config_hash", hash_of_run), ("sqlite", sqlite)):
        register(name, resolver, replace=True)


def with_resume(config: dict[str, Any], run: RunDirectory) -> dict[str, Any]:
    """``config``, which in a sweep resumes from the run's last checkpoint."""
    if not in_sweep() or config["resume"] is not None or run.checkpoint is None:
        return config
    return {**config, "resume": str(run.checkpoint)}


def train_once(run: RunDirectory, config: dict[str, Any], train: Train) -> float | str | None:
    """Train ``run``; in a sweep, return ``BUSY`` if another process works on it, its metric if it is done.
    InputError: outside of a sweep, another process works on it or its directory holds a run."""
    with run.claim(wait=_waits()) as claimed:
        if not claimed and in_sweep():
            print(f"skipped: {run.owner} works on {run.path}", flush=True)
            return BUSY
        if not claimed:
            raise InputError(f"{run.path}: expected a directory that no process works in; found {run.owner}")
        if in_sweep() and run.done:
            print(f"done before: {run.path}", flush=True)
            return run.metric
        config = with_resume(config, run)
        if not in_sweep():
            check_directory(run.path, config)
        with run.session(resumed=config["resume"]) as stats:
            return train(config, run.path, stats)


def check_launcher(config: Mapping[str, Any], launcher: str) -> None:
    """Check that a job of a sweep can train in several processes. InputError: only SLURM starts these."""
    devices = config["trainer"].get("devices", 1)
    fits = devices in (1, "1", [0]) or "slurm" in launcher
    require(fits, "trainer.devices", "1 in a sweep, or hydra/launcher=slurm, which starts processes", devices)


#: What training writes into a run's directory, beside the logs of Hydra.
WRITTEN = ("checkpoints", "csv", "init_from.txt", "metrics.csv", "metrics.json", "pictures")
WRITTEN += ("sessions.jsonl", "tensorboard")


def check_config(config: Mapping[str, Any]) -> None:
    """Check that a run can train. InputError: ``skip=auto``, or a frozen encoder without weights."""
    one_preset = not lookup(config, "skip.choices")
    require(one_preset, "skip", "the preset to train with, or one and token_budgets=[...]", "auto")
    _require_weights(config)


def _require_weights(config: Mapping[str, Any]) -> None:
    trainable = lookup(config, "encoder.trainable")
    starts = config.get("init_from") is not None or config.get("resume") is not None
    if starts or config.get("allow_random_encoder"):
        return
    if lookup(config, "encoder.semantic") is not None:
        raise InputError(
            "init_from: expected a checkpoint of `ghgs pretext` for encoder.semantic, which does not learn in"
            " training; found none: it would stay random (allow_random_encoder=true to try things out)"
        )
    if trainable in (None, "all"):
        return
    raise InputError(
        f"init_from: expected a checkpoint with the encoder's weights for encoder.trainable={trainable},"
        " such as that of `ghgs import vggt=facebook/VGGT-1B compat=none out=vggt.ckpt`; found none:"
        " the encoder would stay random (allow_random_encoder=true to try things out)"
    )


def check_directory(directory: Path, config: Mapping[str, Any]) -> None:
    """Check that no earlier run would be lost; with ``overwrite`` delete it. InputError: there is a run that
    this one does not resume."""
    kept = [*(directory / "checkpoints").glob("*.ckpt"), directory / "csv" / "metrics.csv"]
    earlier = next((path for path in [*kept, directory / "metrics.json"] if path.exists()), None)
    resume = config.get("resume")
    if resume is not None and resolved(resume).is_relative_to(directory.resolve()):
        return
    if config.get("overwrite"):
        source = config.get("init_from")
        safe = source is None or not resolved(source).is_relative_to(directory.resolve())
        require(safe, "init_from", "a file outside the run that overwrite=true deletes", source)
        for path in (directory / name for name in WRITTEN):
            shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    elif earlier is not None:
        last = directory / "checkpoints" / "last.ckpt"
        raise InputError(
            f"{directory}: expected a directory without a run; found {earlier.relative_to(directory)}"
            f" (resume={last} goes on with it, overwrite=true deletes it, hydra.run.dir=... is another)"
        )
