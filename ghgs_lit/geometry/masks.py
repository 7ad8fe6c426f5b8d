"""Where a mask begins and ends, and the patches that it touches."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor


def first_and_last(hits: Bool[Tensor, "*batch n"]) -> tuple[Int[Tensor, "*batch"], Int[Tensor, "*batch"]]:
    """Index of the first and of the last True along the last axis; ``n`` and -1 where there is none."""
    count = hits.shape[-1]
    index = torch.arange(count, device=hits.device)
    return torch.where(hits, index, count).amin(-1), torch.where(hits, index, -1).amax(-1)


def patches_around_subject(
    masks: Bool[Tensor, "b v H W"], patch_size: int, margin: int
) -> Bool[Tensor, "b v h w"]:
    """Patches with a pixel of the subject, and those at most ``margin`` rows and columns from one of them.
    ``masks``: of the photographs; sides are multiples of the patch size."""
    return _grown(F.max_pool2d(masks.float(), patch_size), margin)


def patches_in_window(
    masks: Bool[Tensor, "b v H W"], patch_size: int, margin: int
) -> Bool[Tensor, "b v h w"]:
    """Patches of the smallest rectangle that holds the subject of a view, and of ``margin`` rows and columns
    around it; arguments as of :func:`patches_around_subject`. A view with an empty mask has none."""
    touched = F.max_pool2d(masks.float(), patch_size).bool()
    rows, columns = _between(touched.any(-1)), _between(touched.any(-2))
    return _grown((rows[..., :, None] & columns[..., None, :]).float(), margin)


def _between(hits: Bool[Tensor, "*batch n"]) -> Bool[Tensor, "*batch n"]:
    """From the first to the last True along the last axis."""
    first, last = first_and_last(hits)
    index = torch.arange(hits.shape[-1], device=hits.device)
    return (index >= first[..., None]) & (index <= last[..., None])


def _grown(patches: Float[Tensor, "b v h w"], margin: int) -> Bool[Tensor, "b v h w"]:
    return F.max_pool2d(patches, 2 * margin + 1, 1, margin).bool()
