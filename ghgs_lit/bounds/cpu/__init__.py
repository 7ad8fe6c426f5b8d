"""The two searches of the bounds for CPUs; each cell and each ray ends as soon as its result is known."""

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ghgs_lit.kernels import pool

#: Slices of a grid, and rows of an image, in one task.
_SLICES, _ROWS = 8, 16


def carve(
    outside: UInt8[Tensor, "B V h w"],
    matrices: Float[Tensor, "B V 3 4"],
    position: Float[Tensor, "B 3 n"],
    tolerance: int,
) -> Bool[Tensor, "B n n n"]:
    """Cells of a grid that at most ``tolerance`` views place outside; see :func:`subject_box`. ``outside``: 1
    where a view says "outside". ``position``: centres of the cells along each axis."""
    from ghgs_lit.bounds.cpu.kernel import carve_slices  # here: it loads a compiler

    elements, cells = position.shape[0], position.shape[2]
    kept = torch.empty(elements, cells, cells, cells, dtype=torch.bool)
    arrays = [x.contiguous().numpy() for x in (outside, matrices, position, kept)]
    ranges = [(element, 0, cells) for element in range(elements)]
    pool.run_rows(carve_slices(), (*arrays, tolerance), ranges, _SLICES, kept.numel())
    return kept


def march(
    outside: UInt8[Tensor, "B V h w"],
    masks: Bool[Tensor, "B V h w"],
    matrices: Float[Tensor, "B V 3 4"],
    directions: Float[Tensor, "B V h w 3"],
    centers: Float[Tensor, "B V 3"],
    near: Float[Tensor, "B V h w"],
    far: Float[Tensor, "B V h w"],
    steps: Float[Tensor, " s"],
    tolerance: int,
) -> None:
    """Replace ``near`` and ``far`` by the first and the last depth that the other views allow. ``outside``: 1
    where a view says "outside". ``near``, ``far``: contiguous; unchanged for rays that miss the hull.
    ``steps``: fractions of the way from near to far that are tried. ``tolerance``: votes that an allowed
    depth may have."""
    from ghgs_lit.bounds.cpu.kernel import march_rows

    elements, views, height, _ = masks.shape
    tables = (outside, masks, matrices, directions, centers)
    arrays = [x.contiguous().numpy() for x in tables] + [near.numpy(), far.numpy(), steps.numpy()]
    ranges = [(element, view, 0, height) for element in range(elements) for view in range(views)]
    pool.run_rows(march_rows(), (*arrays, tolerance), ranges, _ROWS, masks.numel())
