"""Which parts of the body the patches of a batch show."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.synthesis.people.body import BODY_VERTICES
from ghgs_lit.training.pretext.parts import PARTS, parts_of_points
from ghgs_lit.types import Batch, Tokens


def has_parts(batch: Batch) -> bool:
    """Whether the bodies of a batch are built-in ones, whose parts are known."""
    bodies = batch.body_vertices or ()
    return len(bodies) > 0 and all(len(body) == BODY_VERTICES for body in bodies)


def token_parts(shares: Float[Tensor, "n P"], tokens: Tokens) -> Int[Tensor, " N"]:
    """The part with the largest share in the patch of each token; -1 where it shows none.

    Args:
        shares: of all patches, from :func:`part_shares`.
        tokens: of the same photographs.
    """
    _, _, h, w = tokens.grid
    own = shares[(tokens.image * h + tokens.row) * w + tokens.column]
    return torch.where(own.any(1), own.argmax(1), -1)


def part_shares(batch: Batch, patch_size: int) -> Float[Tensor, "n P"]:
    """Shares of :data:`PARTS` among the subject's pixels of each patch; 0 where it has no such pixel.

    Args:
        batch: with true depths and the vertices of built-in bodies.
        patch_size: in pixels.

    Returns:
        Of all patches of all images, ordered by image, row and column.

    Raises:
        InputError: the batch has no depths or no bodies, or other bodies.
    """
    require(batch.depths is not None, "data", "true depths, which the labels are made from", "none")
    require(batch.body_vertices is not None, "data", "people with bodies, as data=synthetic", "none")
    b, v, height, width = batch.depths.shape
    valid, points = batch.masks & (batch.depths > 0), unproject_maps(batch.depths, batch.cameras)
    found = torch.cat(
        [parts_of_points(points[i][valid[i]], body) for i, body in enumerate(batch.body_vertices)]
    )
    grid = (b, v, height // patch_size, width // patch_size)
    numbers = torch.arange(grid[0] * grid[1] * grid[2] * grid[3], device=found.device)
    patch = F.interpolate(numbers.view(grid).double(), scale_factor=patch_size).long()[valid]
    counts = torch.bincount(patch * len(PARTS) + found, minlength=len(numbers) * len(PARTS))
    counts = counts.view(-1, len(PARTS)).float()
    return counts / counts.sum(1, keepdim=True).clamp_min(1)
