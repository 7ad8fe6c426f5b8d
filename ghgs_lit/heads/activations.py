"""Activations that turn the raw channels of a dense head into values and a confidence."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.errors import choice
from ghgs_lit.geometry.projection import at_least_float32


def inverse_log(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """``sign(x) (exp(|x|) - 1)``: linear near 0, exponential far away, of either sign."""
    return x.sign() * x.abs().expm1()


def unit(x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    """``x`` divided by its length; 0 stays 0, with a zero gradient."""
    squared = x.square().sum(-1, keepdim=True)
    return torch.where(squared > 0, x * torch.where(squared > 0, squared, 1.0).rsqrt(), 0.0)


def _direction_and_length(x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    direction = unit(x)
    return direction * (direction * x).sum(-1, keepdim=True).expm1()


def _inverse_log_z(x: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    z = inverse_log(x[..., 2:])
    return torch.cat((x[..., :2] * z, z), dim=-1)


VALUES = {
    "linear": lambda x: x,
    "exp": torch.exp,
    "inv_log": inverse_log,
    "norm_exp": _direction_and_length,
    "norm": unit,
    "relu": F.relu,
    "sigmoid": torch.sigmoid,
    "xy_inv_log": _inverse_log_z,
}
CONFIDENCES = {"expp1": lambda c: 1 + c.exp(), "expp0": torch.exp, "sigmoid": torch.sigmoid}


def split_activated(
    raw: Float[Tensor, "n c h w"], value: str, confidence: str = "expp1"
) -> tuple[Float[Tensor, "n h w c-1"], Float[Tensor, "n h w"]]:
    """Activated values and confidence, float32 or wider.

    Published depth heads use ``exp``, point heads ``inv_log``, the release of the paper ``linear``; all with
    ``expp1``.

    Args:
        raw: channels of a dense head, the last one for the confidence.
        value: one of :data:`VALUES`.
        confidence: one of :data:`CONFIDENCES`.
    """
    choice("value activation", value, tuple(VALUES))
    choice("confidence activation", confidence, tuple(CONFIDENCES))
    raw = at_least_float32(raw).permute(0, 2, 3, 1)
    return VALUES[value](raw[..., :-1]), CONFIDENCES[confidence](raw[..., -1])
