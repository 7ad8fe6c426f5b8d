"""Replay of a step that :class:`ghgs_lit.training.guard.Guard` saved, on any machine."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ghgs_lit.config import build
from ghgs_lit.errors import InputError
from ghgs_lit.method.model import GHGS
from ghgs_lit.training.faults import Fault, Step, first_fault
from ghgs_lit.training.module import GHGSModule
from ghgs_lit.types import Batch, Cameras, Targets
from ghgs_lit.weights.checkpoint import STATE_PREFIX, describe
from ghgs_lit.weights.reading import open_file

_KEYS = ("fault", "global_step", "step", "state_dict", "config")


def replay(path: str | Path) -> tuple[int, str, Fault | None]:
    """Run a saved step again on the CPU.

    Args:
        path: a file ``<run>/faults/step_<n>.pt``.

    Returns:
        The step's number, its fault when it was saved, and its fault now (None: none).

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file is not a saved step."""
    content = open_file(path)
    if not isinstance(content, Mapping) or any(key not in content for key in _KEYS):
        raise InputError(f"{path}: expected a step that a training saved; found {describe(content)}")
    config = content["config"]
    model = GHGS.from_config(config)
    parts = (build(config[group], group) for group in ("renderer", "loss", "optimizer"))
    module = GHGSModule(model, *parts, config).train()
    in_model = model.state_dict().keys()
    state = {
        f"{STATE_PREFIX}{name}" if name in in_model else name: value
        for name, value in content["state_dict"].items()
    }
    # Not by a loader that refuses weights that are not finite: they may be the fault.
    module.load_state_dict(state, assign=True)
    return content["global_step"], content["fault"], first_fault(module, _step(content["step"]))


def _step(values: Mapping[str, Any]) -> Step:
    """The inputs of a step from plain data."""
    autocast = getattr(torch, values["autocast"]) if values["autocast"] else None
    batch = values["batch"]
    targets = batch["targets"]
    if targets is not None:
        targets = Targets(**{**targets, "cameras": Cameras(**targets["cameras"])})
    batch = Batch(**{**batch, "cameras": Cameras(**batch["cameras"]), "targets": targets})
    return Step(**{**values, "batch": batch, "autocast": autocast})
