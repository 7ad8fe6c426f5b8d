"""Agreement of masks: a view whose mask contradicts all others does not vote.

In consistent silhouettes of one subject, each ray has a point that all other silhouettes cover
(silhouette coherence; Hernandez et al., PAMI 2007). Nothing here has a gradient."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.constants import constant, middles
from ghgs_lit.geometry.frame import in_cameras
from ghgs_lit.method.bounds.rays import (
    Silhouettes,
    dilate,
    projection_matrices,
    ray_directions,
    votes_outside,
)
from ghgs_lit.ops.ray_marching import NEAREST, look_up

#: Cells along the longer side of the masks, and depths along each ray: enough to find gross errors.
RESOLUTION = 32
_SAMPLES = 24

#: Masks agree if, for each mask, the others explain at least this fraction of its rays.
_SHARE = 0.95


def trusted_views(
    coarse: Silhouettes, center: Float[Tensor, "B 3"], reach: Float[Tensor, " B"], tolerance: int
) -> Bool[Tensor, "B V"]:
    """Select the views that vote about the hull: those that show the subject, except one that
    contradicts the others.

    A mask that misses parts leaves rays of the other views unexplained; a mask that is too large has
    unexplained rays itself. If the masks do not agree (:data:`_SHARE`), the view without which the
    unexplained fraction more than halves does not vote. With two views both vote: either could be
    wrong.

    Args:
        coarse: masks of at most :data:`RESOLUTION` cells along the longer side, and their cameras.
        center: centre of the subject in the world, in metres.
        reach: generous radius of the subject about ``center``, in metres.
        tolerance: number of views in which a kept point may lie outside the mask.
    """
    masks = coarse.masks
    voting = masks.flatten(2).any(-1)
    votes = _votes(coarse, voting, center, reach)
    count = votes.sum(2, keepdim=True)
    # Votes of all views, then of all but each one.
    counts = torch.cat((count, count - votes), 2)
    hit = (counts <= tolerance).any(-1) & masks[:, :, None]
    explained = hit.flatten(3).sum(-1) / masks.flatten(2).sum(-1).clamp(min=1)[..., None]
    # A view without a vote need not be explained.
    silent = constant(torch.eye, masks.shape[1] + 1, like=masks)[1:] | ~voting[..., None]
    agreement = torch.where(silent, 1.0, explained).amin(1)
    best, suspect = agreement[:, 1:].max(1, keepdim=True)
    by_all = agreement[:, :1]
    wrong = (by_all < _SHARE) & (2 * (1 - best) < 1 - by_all) & (voting.sum(1, keepdim=True) > 2)
    return voting & ~torch.zeros_like(voting).scatter(1, suspect, wrong)


def _votes(coarse: Silhouettes, voting: Tensor, center: Tensor, reach: Tensor) -> Tensor:
    """Votes [B, v, o, h, w, S] about points on the rays of all views: 1 where a point on a ray of view
    ``v`` projects outside the mask of view ``o``; depths are sampled within ``reach`` of ``center``."""
    masks = coarse.masks
    cameras = coarse.cameras
    b, v = voting.shape
    # At least one cell: the rays of a cell's pixels differ from the ray of its centre.
    outside = votes_outside(dilate(masks, max(coarse.dilation, 1)), voting, coarse.cut)
    matrices = projection_matrices(cameras)
    middle = in_cameras(center, cameras.extrinsics)[..., 2]
    steps = 2 * constant(middles, _SAMPLES, like=center) - 1
    depth = (middle[..., None] + reach[:, None, None] * steps).clamp(min=NEAREST)
    turn = matrices[..., :3]
    along = torch.einsum("boij,bvhwj->ibvohw", turn, ray_directions(cameras))
    origin = (
        torch.einsum("boij,bvj->ibvo", turn, cameras.centers) + matrices[..., 3].movedim(2, 0)[:, :, None]
    )
    pixels = origin[..., None, None, None] + along[..., None] * depth[:, :, None, None, None]
    image = constant(torch.arange, b * v, like=center, dtype=torch.long).view(b, 1, v, 1, 1, 1)
    return look_up(outside.flatten(0, 1), image, pixels)
