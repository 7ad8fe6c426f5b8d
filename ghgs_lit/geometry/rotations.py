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


def matrix_to_quaternion(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of proper rotations, from the largest of four squares (Shepperd 1978)."""
    (a, ab, ac), (ba, b, bc), (ca, cb, c) = (row.unbind(-1) for row in matrices.unbind(-2))
    x, y, z = cb - bc, ac - ca, ba - ab
    xy, xz, yz = ba + ab, ac + ca, cb + bc
    values = (
        *(1 + a + b + c, x, y, z),
        *(x, 1 + a - b - c, xy, xz),
        *(y, xy, 1 - a + b - c, yz),
        *(z, xz, yz, 1 - a - b + c),
    )
    table = torch.stack(values, dim=-1).unflatten(-1, (4, 4))
    best = table.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = table.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    return chosen / chosen.norm(dim=-1, keepdim=True)


def rotate(
    quaternions: Float[Tensor, "*batch 4"], vectors: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Vectors turned by unit quaternions; a fifth of the time of a product with their matrices."""
    axis = quaternions[..., 1:]
    twice = 2 * torch.linalg.cross(axis, vectors)
    return vectors + quaternions[..., :1] * twice + torch.linalg.cross(axis, twice)


def multiply_quaternions(
    first: Float[Tensor, "*#batch 4"], second: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """The products ``first second``: rotate by ``second``, then by ``first``; norms are multiplied."""
    (a, b, c, d), (w, x, y, z) = first.unbind(-1), second.unbind(-1)
    return torch.stack(
        (
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ),
        dim=-1,
    )
