"""Directions of vectors of any length."""

from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32


def unit(x: Float[Tensor, "*n c"], least: float = 0.0) -> Float[Tensor, "*n c"]:
    """``x`` divided by its length, float32 or wider; 0 stays 0, with a zero gradient.

    Scaled by its largest component first: squares of 1e-20 vanish in float32, those of 1e20 overflow. ``x``:
    vectors of any length. ``least``: the gradient of a shorter vector, which grows as 1 / length, is that at
    this length.
    """
    x = at_least_float32(x)
    largest = x.detach().abs().amax(-1, keepdim=True)
    is_zero = largest == 0
    scaled = x / largest.masked_fill(is_zero, 1.0)
    # The argument is chosen, not the result: a root at 0 would have an infinite gradient.
    squared = scaled.square().sum(-1, keepdim=True).masked_fill(is_zero, 1.0)
    direction = (scaled * squared.rsqrt()).masked_fill(is_zero, 0.0)
    if least == 0 or not direction.requires_grad:
        return direction
    share = (largest * squared.detach().sqrt() / least).clamp(max=1)
    return direction.detach() + share * (direction - direction.detach())
