"""The search along rays for CPUs: each ray ends as soon as its result is known."""

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ghgs_lit.kernels import pool
from ghgs_lit.kernels.pool import have_values, is_supported
from ghgs_lit.types import DepthBounds

#: Rows of an image in one task.
_ROWS = 16


def fits(*tensors: Tensor) -> bool:
    """Whether :func:`march` computes with these matrices, directions and bounds.

    Args:
        tensors: of any shapes.
    """
    return is_supported(*tensors) and have_values(*tensors)


def march(
    outside: UInt8[Tensor, "B V h w"],
    masks: Bool[Tensor, "B V h w"],
    matrices: Float[Tensor, "B V 3 4"],
    directions: Float[Tensor, "B V h w 3"],
    centers: Float[Tensor, "B V 3"],
    start: DepthBounds,
    steps: Float[Tensor, " s"],
    tolerance: int,
) -> DepthBounds:
    """The first and the last depth of each ray that the other views allow.

    The arithmetic is that of :mod:`ghgs_lit.method.bounds.hull` in plain PyTorch, so that bits agree where
    processors round products and sums once.

    Args:
        outside: 1 where a view says "outside".
        masks: the subject's pixels, whose rays are marched.
        matrices: of projection.
        directions: of the rays.
        centers: of the cameras.
        start: bounds [B, V, h, w] in metres, between which depths are tried.
        steps: fractions of the way from near to far that are tried.
        tolerance: votes that an allowed depth may have.

    Returns:
        Bounds [B, V, h, w] in metres; those of ``start`` for rays that miss the hull.
    """
    from ghgs_lit.method.bounds.cpu.kernel import march_rows  # here: it loads a compiler

    elements, views, height, _ = masks.shape
    near, far = (bound.clone(memory_format=torch.contiguous_format) for bound in (start.near, start.far))
    tables = (outside, masks, matrices, directions, centers, near, far, steps)
    arrays = [table.contiguous().numpy() for table in tables]
    ranges = [(image // views, image % views, 0, height) for image in range(elements * views)]
    pool.run_rows(march_rows(), (*arrays, tolerance), ranges, _ROWS, masks.numel())
    return DepthBounds(near, far)
