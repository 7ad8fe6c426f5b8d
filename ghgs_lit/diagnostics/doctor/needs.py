"""The parameters of a configuration, by stage."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from ghgs_lit.model import GHGS, HEADS


@dataclass(frozen=True)
class Needs:
    """Of one stage: parameters, and those that are trained."""

    stage: str
    parameters: int
    trained: int


def needs(config: Mapping[str, Any]) -> list[Needs]:
    """Of each stage with weights, and of the whole ``model``, last; no memory is taken for it.

    Args:
        config: of the model.
    """
    with torch.device("meta"):
        model = GHGS.from_config(config)
    return [_of(name, getattr(model, name)) for name in ("encoder", *HEADS)] + [_of("model", model)]


def _of(name: str, module: nn.Module) -> Needs:
    sizes = [(p.numel(), p.requires_grad) for p in module.parameters()]
    return Needs(name, sum(n for n, _ in sizes), sum(n for n, trained in sizes if trained))
