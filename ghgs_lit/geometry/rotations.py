"""Quaternions ``(w, x, y, z)`` and rotation matrices."""

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32


def quaternion_to_matrix(quaternions: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions of any non-zero norm; the zero quaternion gives identity.

    Scaled by the largest component first, so that norms of 1e-30 or 1e30 neither vanish nor overflow.
    """
    q = at_least_float32(quaternions)
    largest = q.abs().amax(-1, keepdim=True).detach()
    is_zero = largest == 0
    q = q / torch.where(is_zero, torch.ones_like(largest), largest)
    identity = torch.zeros_like(q)
    identity[..., 0] = 1
    q = torch.where(is_zero, identity, q)
    w, x, y, z = (q / q.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
