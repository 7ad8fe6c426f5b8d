"""Two-dimensional rotary position embedding (RoPE): half of a head turns with the row, half with the column.

Angles are float32 or wider for tokens of any precision: rounding an angle to bfloat16 would change its
cosine by up to 6e-2, rounding the cosine itself only by 2e-3.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32

BASE = 100.0


class Rotary(NamedTuple):
    """Cosine and sine for every token and channel of a head; the sine has the sign of its term."""

    cosine: Float[Tensor, "t d"]
    sine: Float[Tensor, "t d"]


def rotary_tables(positions: Int[Tensor, "t 2"], head_width: int, like: Tensor) -> Rotary:
    """Tables of all tokens.

    Args:
        positions: row and column of each token.
        head_width: channels of a head, divisible by 4.
        like: tokens; the tables are float32, or float64 for tokens in float64.
    """
    exponents = torch.arange(0, head_width, 4, device=positions.device, dtype=torch.float32) / head_width
    angles = positions.float()[..., None] * (1.0 / BASE**exponents)
    angles = angles.to(at_least_float32(like).dtype)
    cosine, sine = angles.cos(), angles.sin()
    return Rotary(
        torch.stack((cosine, cosine), dim=-2).flatten(-3), torch.stack((-sine, sine), dim=-2).flatten(-3)
    )


def rotate(x: Float[Tensor, "*batch t d"], rotary: Rotary) -> Float[Tensor, "*batch t d"]:
    """Rotate channel ``m`` of each half of a head with its partner ``m + d/4``; in the tables' dtype."""
    quarters = x.unflatten(-1, (2, 2, x.shape[-1] // 4))
    return torch.addcmul(x * rotary.cosine, quarters.flip(-2).flatten(-3), rotary.sine)
