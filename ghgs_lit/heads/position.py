"""Sinusoidal positions that the DPT head adds to its maps."""

import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.heads.window import Window

SCALE = 0.1
BASE = 100.0


@lru_cache(maxsize=64)
def _axis_waves(
    channels: int, count: int, half_extent: float, dtype: torch.dtype, device: torch.device
) -> Float[Tensor, "c n"]:
    """Sines, then cosines along one axis times ``SCALE``, at the centres of ``count`` cells between
    ``-half_extent`` and ``+half_extent``; computed in float64, returned in float32."""
    quarter = channels // 2
    exponents = torch.arange(quarter, dtype=torch.float64, device=device) / quarter
    omega = 1.0 / BASE**exponents
    bound = half_extent * (count - 1) / count
    angles = omega[:, None] * torch.linspace(-bound, bound, count, dtype=dtype, device=device).double()
    return torch.cat((angles.sin(), angles.cos())).float() * SCALE


def add_positions_(
    x: Float[Tensor, "n c h w"], aspect: float, window: Window | None = None
) -> Float[Tensor, "n c h w"]:
    """Add ``0.1 E`` to ``x`` in place, in its precision: waves of x in the first half of the channels, of y
    in the second.

    The unit is half the diagonal of the image; samples are cell centres. The waves of the two axes are cached
    (a few kilobytes each); the embedding is never held as a map.

    Args:
        x: maps whose number of channels is a multiple of 4; float64 gives float64 coordinates.
        aspect: width / height of the image.
        window: the part of whole maps that ``x`` is; None: all of it.
    """
    window = window or Window.whole(tuple(x.shape[2:]))
    half = x.shape[1] // 2
    dtype = torch.float64 if x.dtype == torch.float64 else torch.float32
    diagonal = math.hypot(aspect, 1.0)
    across, down = (
        _axis_waves(half, span.full, extent / diagonal, dtype, x.device)[:, span.start : span.stop]
        for span, extent in ((window.columns, aspect), (window.rows, 1.0))
    )
    x[:, :half].add_(across[:, None, :].to(x.dtype))
    x[:, half:].add_(down[:, :, None].to(x.dtype))
    return x
