"""Where a mask begins and ends, and the patches that it touches."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Int
from torch import Tensor


def first_and_last(
    hits: Bool[Tensor, "*batch n"],
) -> tuple[Int[Tensor, "*batch"], Int[Tensor, "*batch"]]:
    """Index of the first and of the last True along the last axis; ``n`` and -1 where there is none."""
    count = hits.shape[-1]
    index = torch.arange(count, device=hits.device)
    return torch.where(hits, index, count).amin(-1), torch.where(hits, index, -1).amax(-1)


def patches_around_subject(
    masks: Bool[Tensor, "b v H W"], patch_size: int, margin: int
) -> Bool[Tensor, "b v h w"]:
    """Patches with a pixel of the subject, and those at most ``margin`` rows and columns from one of them.

    Args:
        masks: of the photographs; sides are multiples of the patch size.
        patch_size: in pixels.
        margin: in patches.
    """
    touched = F.max_pool2d(masks.float(), patch_size)
    return F.max_pool2d(touched, 2 * margin + 1, 1, margin).bool()
