"""What a run is refused for before anything is loaded, prepared or overwritten."""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ghgs_lit.config.keys import lookup
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import resolved

#: What training writes below a run's directory, beside the logs of Hydra.
WRITTEN = (
    "checkpoints",
    "csv",
    "init_from.txt",
    "metrics.csv",
    "metrics.json",
    "pictures",
    "sessions.jsonl",
    "tensorboard",
)


def check_config(config: Mapping[str, Any]) -> None:
    """Refuse a run that cannot give what it is started for. InputError: ``skip=auto``, or a frozen
    encoder without weights."""
    one_preset = not lookup(config, "skip.choices")
    require(one_preset, "skip", "the preset to train with, or one and token_budgets=[...]", "auto")
    _require_weights(config)


def _require_weights(config: Mapping[str, Any]) -> None:
    """A part of an encoder that does not learn must have learned before."""
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
    """Refuse to train where an earlier run would be lost; with ``overwrite`` remove it. InputError: there is
    a run, and this one does not go on from it."""
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
