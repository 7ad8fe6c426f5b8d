"""Checkpoints of this package: plain data that carries the whole configuration and rebuilds its model."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from ghgs_lit.config.legacy import upgrade
from ghgs_lit.errors import InputError, require
from ghgs_lit.weights.names import RELEASE_ENTRY, VGGT
from ghgs_lit.weights.reading import open_file

#: Version of the checkpoints that are written and read.
FORMAT_VERSION = 1

#: Where a LightningModule keeps its model.
STATE_PREFIX = "model."


def read_checkpoint(path: str | Path, map_location: Any = "cpu") -> dict[str, Any]:
    """Read a checkpoint, tensors mapped from the disk, and refuse what is not one of this package.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it is no checkpoint; the line names the path, what was expected and what was found.
    """
    checkpoint = open_file(path, map_location)
    for key, kind in (("state_dict", Mapping), ("config", Mapping), ("format_version", int)):
        found = checkpoint.get(key) if isinstance(checkpoint, Mapping) else None
        if not isinstance(found, kind):
            hint = " (`ghgs import` makes a checkpoint of published weights)" * _is_published(checkpoint)
            raise InputError(f"{path}: expected a checkpoint with {key!r}; found {summary(checkpoint)}{hint}")
    version = checkpoint["format_version"]
    if not 1 <= version <= FORMAT_VERSION:
        newer = ", of a newer version of this package" if version > FORMAT_VERSION else ""
        raise InputError(f"{path}: expected format_version 1 to {FORMAT_VERSION}; found {version}{newer}")
    return {**checkpoint, "config": upgrade(checkpoint["config"])}


def _is_published(content: Any) -> bool:
    return isinstance(content, Mapping) and any(
        name == RELEASE_ENTRY or str(name).startswith(tuple(VGGT)) for name in content
    )


def summary(content: Any) -> str:
    """What a file holds instead of what was expected, in a few words."""
    if not isinstance(content, Mapping):
        return f"a {type(content).__name__}"
    names = [repr(name) for name in content]
    more = f" and {len(names) - 4} more" if len(names) > 5 else ""
    return ", ".join(names[: 4 if more else 5]) + more if names else "an empty mapping"


def model_state(checkpoint: Mapping[str, Any]) -> dict[str, Tensor]:
    """The tensors of the model, without what a LightningModule holds beside it."""
    return {
        key.removeprefix(STATE_PREFIX): value
        for key, value in checkpoint["state_dict"].items()
        if key.startswith(STATE_PREFIX)
    }


def require_fit(module: nn.Module, state: Mapping[str, Any], source: str | Path) -> None:
    """Refuse tensors that are not exactly those of ``module``, which may be on the meta device.

    Raises:
        InputError: a key is missing, unknown, or of another shape; it names source, key and both shapes.
    """
    own = module.state_dict()
    for key in own:
        require(key in state, f"{source}: {key}", f"a tensor of shape {tuple(own[key].shape)}", "nothing")
    for key, value in state.items():
        require(key in own, f"{source}: {key}", "no such key in the configured model", shape_of(value))
        require_shape(f"{source}: {key}", own[key], value)


def load_strictly(module: nn.Module, state: Mapping[str, Any], source: str | Path) -> None:
    """Copy all of ``state`` into ``module``; refuses what :func:`require_fit` refuses."""
    require_fit(module, state, source)
    module.load_state_dict(state)


def require_shape(key: str, own: Tensor, found: Any) -> None:
    """Refuse what does not fit the configured model's tensor ``own``."""
    expected = f"shape {tuple(own.shape)} of the configured model"
    require(shape_of(found) == tuple(own.shape), key, expected, shape_of(found))
    require(found.is_floating_point(), key, "floating point numbers", found.dtype)


def shape_of(value: Any) -> Any:
    return tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__


def write_aside(path: str | Path, write: Any) -> None:
    """Let ``write(path)`` write a file beside ``path``, then rename it: ``path`` is whole or not there."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        write(aside)
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def write_checkpoint(path: str | Path, state: Mapping[str, Tensor], config: Mapping[str, Any], **facts: Any):
    """Write a checkpoint of a model's ``state``; ``facts`` are further plain data."""
    content = {
        "state_dict": {f"{STATE_PREFIX}{key}": value for key, value in state.items()},
        "config": dict(config),
        "format_version": FORMAT_VERSION,
        **facts,
    }
    write_aside(path, lambda aside: torch.save(content, aside))
