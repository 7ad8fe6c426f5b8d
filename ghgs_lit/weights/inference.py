"""A checkpoint for prediction alone: weights in half precision and their configuration."""

from pathlib import Path

import torch

from ghgs_lit.errors import InputError
from ghgs_lit.weights.checkpoint import model_state, read_checkpoint, require_finite, write_checkpoint
from ghgs_lit.weights.reading import cast

_NOWHERE = {"resume": None, "init_from": None}  # paths of the machine that trained it
_FACTS = ("imported",)  # what loading reads beside weights and configuration


def write_inference(checkpoint: str | Path, path: str | Path, dtype: str) -> None:
    """Write the model of ``checkpoint`` without optimizer, losses and progress. InputError: a weight is too
    large for ``dtype``, or both are one file. ``dtype``: of all weights: ``float16``, ``bfloat16`` or
    ``float32``."""
    if Path(checkpoint).resolve() == Path(path).resolve():
        raise InputError(f"inference={path}: expected another file than the checkpoint; found the same")
    content = read_checkpoint(checkpoint, whole=True)
    state = cast(lambda: model_state(read_checkpoint(checkpoint)), lambda *_: getattr(torch, dtype))
    require_finite(state, f"{checkpoint} as {dtype}")
    facts = {name: content[name] for name in _FACTS if name in content}
    write_checkpoint(path, state, {**content["config"], **_NOWHERE}, **facts)
