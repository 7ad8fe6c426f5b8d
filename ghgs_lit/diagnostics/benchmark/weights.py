"""Models with weights that nobody trained, for run times and for what skipping changes."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from ghgs_lit.model import GHGS


def random_model(config: Mapping[str, Any], seed: int = 0) -> GHGS:
    """A model with random weights, without the time of the usual initialisation.

    No last layer is 0, as it is at the start of training: every output depends on the photographs.
    """
    generator = torch.Generator().manual_seed(seed)

    def value(name: str, parameter: Tensor) -> Tensor:
        if parameter.dim() == 1:
            return torch.full(parameter.shape, float(name in ("weight", "gamma")))
        return torch.randn(parameter.shape, generator=generator) * parameter[0].numel() ** -0.5

    return filled_model(config, value).requires_grad_(False).eval()


@torch.no_grad()
def filled_model(config: Mapping[str, Any], value: Callable[[str, Tensor], Tensor]) -> GHGS:
    """A model whose parameters are ``value(name, parameter)``, from the last name and the shape of each."""
    with torch.device("meta"):
        model = GHGS.from_config(config)
    for module in model.modules():
        for name, parameter in module._parameters.items():
            if parameter is not None:
                trained = parameter.requires_grad
                module._parameters[name] = nn.Parameter(value(name, parameter), requires_grad=trained)
    return model
