"""Models with weights that nobody trained, for run times and for what skipping changes."""

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from ghgs_lit.model import GHGS


@torch.no_grad()
def random_model(config: Mapping[str, Any], seed: int = 0) -> GHGS:
    """A model with random weights, without the time of the usual initialisation.

    No last layer is 0, as it is at the start of training: every output depends on the photographs.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.device("meta"):
        model = GHGS.from_config(config)
    for module in model.modules():
        for name, parameter in module._parameters.items():
            if parameter is None:
                continue
            if parameter.dim() == 1:
                value = torch.full(parameter.shape, float(name in ("weight", "gamma")))
            else:
                value = torch.randn(parameter.shape, generator=generator) * parameter[0].numel() ** -0.5
            module._parameters[name] = nn.Parameter(value, requires_grad=False)
    return model.eval()
