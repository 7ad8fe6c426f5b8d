"""What a configuration needs: parameters, and the memory that weights and training state take."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from ghgs_lit.model import GHGS, HEADS

#: Bytes of a trained parameter beside its weight, in float32: a gradient and AdamW's two moments.
_TRAINED = 3 * 4


@dataclass(frozen=True)
class Needs:
    """Of one stage: parameters, those that are trained, and bytes of weights and of the training's state."""

    stage: str
    parameters: int
    trained: int

    @property
    def weights(self) -> int:
        """Bytes in float32."""
        return 4 * self.parameters

    @property
    def training(self) -> int:
        """Bytes of weights, gradients and AdamW's moments in float32."""
        return self.weights + _TRAINED * self.trained


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
