"""Replay of a step that :class:`ghgs_lit.training.guard.Guard` saved, on any machine."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from ghgs_lit.config import build
from ghgs_lit.errors import InputError
from ghgs_lit.model import GHGS
from ghgs_lit.training.guard import Fault, Step, first_fault
from ghgs_lit.training.module import GHGSModule
from ghgs_lit.types import Batch, Cameras, Targets
from ghgs_lit.weights.checkpoint import describe
from ghgs_lit.weights.reading import open_file

_KEYS = ("fault", "global_step", "step", "state_dict", "config")


def replay(path: str | Path) -> tuple[int, str, Fault | None]:
    """Run a saved step again on the CPU. Returns its number, its fault when it was saved, and its fault now
    (None: none). FileNotFoundError: no such file. InputError: the file is not a saved step."""
    content = open_file(path)
    if not isinstance(content, Mapping) or any(key not in content for key in _KEYS):
        raise InputError(f"{path}: expected a step that a training saved; found {describe(content)}")
    config = content["config"]
    model = GHGS.from_config(config)
    # Not by a loader that refuses weights that are not finite: they may be the fault.
    model.load_state_dict(content["state_dict"], assign=True)
    parts = (build(config[group], group) for group in ("renderer", "loss", "optimizer"))
    module = GHGSModule(model, *parts, config).train()
    return content["global_step"], content["fault"], first_fault(module, _step(content["step"]))


def _step(values: Mapping[str, Any]) -> Step:
    autocast = getattr(torch, values["autocast"]) if values["autocast"] else None
    batch, targets = values["batch"], values["batch"]["targets"]
    if targets is not None:
        targets = Targets(**{**targets, "cameras": Cameras(**targets["cameras"])})
    batch = Batch(**{**batch, "cameras": Cameras(**batch["cameras"]), "targets": targets})
    return Step(**{**values, "batch": batch, "autocast": autocast})
