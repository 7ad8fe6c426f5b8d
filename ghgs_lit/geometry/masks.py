"""Where a mask begins and ends."""

import torch
from jaxtyping import Bool, Int
from torch import Tensor


def first_and_last(
    hits: Bool[Tensor, "*batch n"],
) -> tuple[Int[Tensor, "*batch"], Int[Tensor, "*batch"]]:
    """Index of the first and of the last True along the last axis; ``n`` and -1 where there is none."""
    count = hits.shape[-1]
    index = torch.arange(count, device=hits.device)
    return torch.where(hits, index, count).amin(-1), torch.where(hits, index, -1).amax(-1)
