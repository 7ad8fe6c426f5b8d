"""The plane sweep, distributed over threads; the result has the same bits with any number of them."""

import math
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.kernels import pool
from ghgs_lit.kernels.parts import even_parts

#: Rows of an image of one task.
_ROWS = 16


def padded(colors: Float[Tensor, "B V 4 H W"]) -> Tensor:
    """Smoothed photographs, and their masks as a fourth channel, as the kernel reads them: flat, with a rim.

    The rim of zeros is what lies outside a photograph; one pixel's channels lie side by side. Whole
    vectors are read, of the last pixels beyond the end.
    """
    from ghgs_lit.kernels.simd import LANES  # here: it loads a compiler

    elements, views, _, height, width = colors.shape
    shape = (elements, views, height + 2, width + 2, 4)
    flat = colors.new_zeros(math.prod(shape) + LANES, dtype=torch.float32)
    flat[:-LANES].view(shape)[:, :, 1:-1, 1:-1] = colors.movedim(2, -1)
    return flat


def sweep(
    colors: Float[Tensor, " n"],
    masks: Bool[Tensor, "B V H W"],
    near: Float[Tensor, "B V H W"],
    far: Float[Tensor, "B V H W"],
    turn: Float[Tensor, "B V V 3 3"],
    shift: Float[Tensor, "B V V 3"],
    compared: Bool[Tensor, "B V V"],
    shares: Float[Tensor, " S"],
    tolerance: float,
) -> Float[Tensor, "B V H W S"]:
    """Agreement of the subject's pixels with the best other view; 0 elsewhere.

    Args:
        colors: of all views, :func:`padded`.
        masks: of the subject.
        near, far: of the depths that are compared.
        turn, shift: from pixels of a view (second axis) to those of another (third axis).
        compared: which pairs of views are compared.
        shares: of the way from near to far.
        tolerance: difference of colours at which the agreement is 1 / e.
    """
    from ghgs_lit.geometry.cpu.kernel import sweep_rows  # here: it loads a compiler

    elements, views, height, width = masks.shape
    result = np.zeros((elements, views, height, width, len(shares)), np.float32)
    tables = [
        x.detach().contiguous().numpy() for x in (colors, masks, near, far, turn, shift, compared, shares)
    ]
    pool.run(
        [
            partial(
                sweep_rows(),
                *tables,
                tolerance,
                result,
                element,
                view,
                part.start,
                part.stop,
            )
            for element in range(elements)
            for view in range(views)
            for part in even_parts(height, _ROWS)
        ],
        masks.numel(),
    )
    return torch.from_numpy(result)
