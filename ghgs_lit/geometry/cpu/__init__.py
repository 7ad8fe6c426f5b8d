"""Photo-consistency for CPUs (:mod:`ghgs_lit.geometry.photo_consistency`)."""

import math
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.kernels import pool

_PIXELS = 1024  #: Pixels in one task
_ROWS = 64  #: Rows of an image in one task


def padded(photo: Float[Tensor, "B V 3 H W"], masks: Bool[Tensor, "B V H W"]) -> Tensor:
    """Smoothed photographs with their masks as a fourth channel, as one flat array for the kernel.

    Args:
        photo: colours of the surface [B, V, 3, H, W], float32.
        masks: of the subject [B, V, H, W].

    Returns:
        Channels are innermost. A rim of zeros surrounds each photograph, and the end is padded for
        reads of whole vectors.
    """
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

    Args:
        colors: all views, of :func:`padded`.
        pixels: ascending indices among those of all images.
        near: least depth of each pixel, in the unit of the cameras.
        far: largest depth of each.
        size: height and width of an image.
        turn: matrices from pixels of a view (second axis) to another (third axis), as is the next.
        shift: what is added in the other view.
        compared: whether two views are compared.
        shares: fractions of the way from near to far, in (0, 1).
        tolerance: mean difference of colours at which the agreement is 1 / e.

    Returns:
        [N, S] in [0, 1], float32.
    """
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
