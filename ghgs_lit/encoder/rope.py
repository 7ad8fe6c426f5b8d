"""Two-dimensional rotary positions: the first half of a head turns with the row, the second with the column.

Angles are float32 or wider whatever the precision of the tokens: in bfloat16 a rounded angle would move
its cosine by up to 6e-2, a rounded cosine only by 2e-3.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32

BASE = 100.0


class Rotary(NamedTuple):
    """Factors of every token and channel of a head; ``sine`` carries the sign of its partner's term."""

    cosine: Float[Tensor, "t d"]
    sine: Float[Tensor, "t d"]

    def repeat(self, views: int) -> "Rotary":
        """Tables for ``views`` sequences laid end to end: every view has the same positions."""
        return Rotary(self.cosine.repeat(views, 1), self.sine.repeat(views, 1))


def token_positions(height: int, width: int, special: int, device=None) -> Int[Tensor, "t 2"]:
    """``(row, column)`` of a sequence: ``special`` tokens at (0, 0), then patches from (1, 1), row-major."""
    rows = torch.arange(1, height + 1, device=device).repeat_interleave(width)
    columns = torch.arange(1, width + 1, device=device).repeat(height)
    return torch.nn.functional.pad(torch.stack((rows, columns), dim=-1), (0, 0, special, 0))


def rotary_tables(positions: Int[Tensor, "t 2"], head_width: int, like: Tensor) -> Rotary:
    """Tables for heads of ``head_width`` channels (divisible by 4), wide enough for tokens ``like``."""
    exponents = torch.arange(0, head_width, 4, device=positions.device, dtype=torch.float32) / head_width
    angles = positions.float()[..., None] * (1.0 / BASE**exponents)
    angles = angles.to(at_least_float32(like).dtype)
    cosine, sine = angles.cos(), angles.sin()
    return Rotary(
        torch.stack((cosine, cosine), dim=-2).flatten(-3), torch.stack((-sine, sine), dim=-2).flatten(-3)
    )


def rotate(x: Float[Tensor, "*batch t d"], rotary: Rotary) -> Float[Tensor, "*batch t d"]:
    """Turn channel ``m`` of each half of a head with its partner ``m + d/4``; in the tables' type."""
    quarters = x.unflatten(-1, (2, 2, x.shape[-1] // 4))
    return torch.addcmul(x * rotary.cosine, quarters.flip(-2).flatten(-3), rotary.sine)
