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

    Args:
        config: of the model.
        seed: of the weights.
    """
    with torch.device("meta"):
        model = GHGS.from_config(config)
    generator = torch.Generator().manual_seed(seed)
    for module in model.modules():
        for name, parameter in module._parameters.items():
            if parameter is None:
                continue
            value = torch.empty(parameter.shape)
            if parameter.dim() > 1:
                value.normal_(std=parameter[0].numel() ** -0.5, generator=generator)
            else:
                value.fill_(float(name in ("weight", "gamma")))
            module._parameters[name] = nn.Parameter(value, requires_grad=False)
    return model.eval()
