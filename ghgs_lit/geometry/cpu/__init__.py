"""Photo-consistency for CPUs (:mod:`ghgs_lit.geometry.photo_consistency`)."""

import math
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.kernels import pool

#: Pixels, and rows of an image, in one task.
_PIXELS = 1024
_ROWS = 64


def padded(photo: Float[Tensor, "B V 3 H W"], masks: Bool[Tensor, "B V H W"]) -> Tensor:
    """Smoothed photographs with their masks as a fourth channel, as one flat array for the kernel. Channels
    are innermost. A rim of zeros surrounds each photograph, and the end is padded for reads of whole
    vectors."""
    from ghgs_lit.geometry.cpu.kernel import smooth_rows  # here: it loads a compiler
    from ghgs_lit.kernels.simd import LANES

    elements, views, height, width = masks.shape
    flat = photo.new_zeros(elements * views * (height + 2) * (width + 2) * 4 + LANES)
    arrays = [x.flatten(0, 1).contiguous().numpy() for x in (photo, masks)]
    ranges = [(image, 0, height) for image in range(elements * views)]
    pool.run_rows(smooth_rows(), (*arrays, flat.numpy()), ranges, _ROWS, masks.numel() // 8)
    return flat


def sweep(
    colors: Float[Tensor, " n"],
    pixels: Int[Tensor, " N"],
    near: Float[Tensor, " N"],
    far: Float[Tensor, " N"],
    size: tuple[int, int],
    turn: Float[Tensor, "B V V 3 3"],
    shift: Float[Tensor, "B V V 3"],
    compared: Bool[Tensor, "B V V"],
    shares: Float[Tensor, " S"],
    tolerance: float,
) -> Float[Tensor, "N S"]:
    """Agreement of pixels with the best other view, as :mod:`ghgs_lit.geometry.photo_consistency`.
    ``colors``: all views, :func:`padded`. ``pixels``: ascending. ``turn``, ``shift``: map pixels of a view
    (second axis) to another (third axis). ``shares``: fractions of the way from near to far."""
    from ghgs_lit.geometry.cpu.kernel import sweep_pixels  # here: it loads a compiler

    result = np.empty((len(pixels), len(shares)), np.float32)
    tables = [
        x.detach().contiguous().numpy() for x in (colors, pixels, near, far, turn, shift, compared, shares)
    ]
    images = np.arange(compared[..., 0].numel() + 1) * math.prod(size)
    ends = np.searchsorted(tables[1], images).tolist()
    ranges = [(image, *pair) for image, pair in enumerate(pairwise(ends))]
    pool.run_rows(sweep_pixels(), (*tables, tolerance, result, *size), ranges, _PIXELS, result.size)
    return torch.from_numpy(result)
