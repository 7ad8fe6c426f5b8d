"""Directions, quaternions ``(w, x, y, z)``, rotation matrices, and small motions of cameras.

Images determine neither the pose of a rig as a whole nor its distance from a subject of unknown
size: only relative motions of the cameras are observable."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.projection import at_least_float32


def quaternion_to_matrix(quaternions: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions of any norm.

    Quaternions are first divided by their largest component: norms of 1e-30 or 1e30 are valid.

    Args:
        quaternions: ``(w, x, y, z)`` [..., 4]; the zero quaternion gives the identity.

    Returns:
        Matrices [..., 3, 3], float32 or wider.
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


#: The 16 values of Shepperd's table as sums of at most four signed numbers. Index 0 is the constant
#: 1; entries of the matrix are indexed from 1, by row.
_OWN = (0, 1, 5, 9)
_X = (8, 6, 0, 0)
_Y = (3, 7, 0, 0)
_Z = (4, 2, 0, 0)
_TABLE = (*(_OWN, _X, _Y, _Z), *(_X, _OWN, _Z, _Y), *(_Y, _Z, _OWN, _X), *(_Z, _Y, _X, _OWN))
_MINUS = (1, -1, 0, 0)
_PLUS = (1, 1, 0, 0)
_TABLE_SIGNS = (
    *((1, 1, 1, 1), _MINUS, _MINUS, _MINUS),
    *(_MINUS, (1, 1, -1, -1), _PLUS, _PLUS),
    *(_MINUS, _PLUS, (1, -1, 1, -1), _PLUS),
    *(_MINUS, _PLUS, _PLUS, (1, -1, -1, 1)),
)


def matrix_to_quaternion(matrices: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 4"]:
    """Unit quaternions of rotation matrices (Shepperd, 1978).

    Args:
        matrices: proper rotations [..., 3, 3].

    Returns:
        ``(w, x, y, z)`` [..., 4].
    """
    numbers = F.pad(matrices.flatten(-2), (1, 0), value=1.0)
    table = _gather_signed(numbers, _TABLE, _TABLE_SIGNS).sum(-1).unflatten(-1, (4, 4))
    best = table.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = table.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    return chosen / chosen.norm(dim=-1, keepdim=True)


def _gather_signed(
    numbers: Float[Tensor, "*batch n"], places: tuple, signs: tuple
) -> Float[Tensor, "*batch r 4"]:
    """Gather the numbers at ``places`` (rows of four) and multiply them by ``signs``."""
    index = constant(torch.tensor, sum(places, ()), like=numbers, dtype=torch.long)
    chosen = numbers.index_select(-1, index).unflatten(-1, (-1, 4))
    return chosen * constant(torch.tensor, signs, like=numbers)


def rotate(
    quaternions: Float[Tensor, "*batch 4"], vectors: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Rotate vectors by unit quaternions ``(w, x, y, z)``, in a fifth of the time of matrix
    products."""
    axis = quaternions[..., 1:]
    twice = 2 * torch.linalg.cross(axis, vectors)
    return vectors + quaternions[..., :1] * twice + torch.linalg.cross(axis, twice)


#: For z, y, x and w of a product (the order in which gradients are summed): components of the second
#: quaternion that multiply w, x, y, z of the first, and the signs of these products.
_FACTORS = ((3, 2, 1, 0), (2, 3, 0, 1), (1, 0, 3, 2), (0, 1, 2, 3))
_FACTOR_SIGNS = ((1, 1, -1, 1), (1, -1, 1, 1), (1, 1, 1, -1), (1, -1, -1, -1))


def multiply_quaternions(
    first: Float[Tensor, "*#batch 4"], second: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """Hamilton product ``first second``: the rotation by ``second``, then by ``first``.

    Quaternions are ``(w, x, y, z)`` of any norm; norms multiply.
    """
    return (first[..., None, :] * _gather_signed(second, _FACTORS, _FACTOR_SIGNS)).sum(-1).flip(-1)


def unit(x: Float[Tensor, "*n c"], least: float = 0.0) -> Float[Tensor, "*n c"]:
    """Normalise vectors to unit length, in float32 or wider; 0 stays 0, with a zero gradient.

    Vectors are first divided by their largest component: in float32, squares of 1e-20 vanish and
    those of 1e20 overflow.

    Args:
        x: vectors [..., c].
        least: length below which the gradient, which grows as 1 / length, stays constant.
    """
    x = at_least_float32(x)
    largest = x.detach().abs().amax(-1, keepdim=True).clamp(min=torch.finfo(x.dtype).tiny)
    scaled = x / largest
    squared = scaled.square().sum(-1, keepdim=True)
    # At least 1 unless x is 0, where a root would have an infinite gradient.
    direction = scaled * squared.clamp(min=1).rsqrt()
    if not direction.requires_grad:
        return direction
    direction = direction.masked_fill(squared < 1, 0.0)
    if least == 0:
        return direction
    share = (largest * squared.detach().sqrt() / least).clamp(max=1)
    return direction.detach() + share * (direction - direction.detach())


#: Relative weight of a translation along the optical axis, which is hardly visible (it resembles a
#: change of focal length).
_ALONG = 0.01


def remove_common_motion(
    motions: Float[Tensor, "*b V 6"], axes: Float[Tensor, "*b V 3"]
) -> Float[Tensor, "*b V 6"]:
    """Remove the motion common to all cameras: the mean, and the mean shift along optical axes.

    The mean shift is the one that minimises the remaining shifts across the optical axes (least
    squares).

    Args:
        motions: rotation vectors of points, in radians, and shifts [..., V, 6], in world axes.
        axes: optical axes of the cameras [..., V, 3], unit vectors in the world.

    Returns:
        Motions [..., V, 6].
    """
    turn, shift = motions.split(3, -1)
    turn = turn - turn.mean(-2, keepdim=True)
    across = torch.eye(3).to(axes) - (1 - _ALONG) * axes[..., :, None] * axes[..., None, :]
    # Written out: matmul would run in half precision under autocast.
    mean = torch.linalg.solve(across.sum(-3), (across * shift[..., None, :]).sum((-3, -1)))
    shift = shift - mean[..., None, :]
    along = (shift * axes).sum(-1, keepdim=True).mean(-2, keepdim=True)
    return torch.cat((turn, shift - along * axes), -1)


def rigid(
    motions: Float[Tensor, "*n 6"], length: float = 1.0
) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
    """Rotation matrices and translations of small motions.

    Args:
        motions: rotation vectors in radians, and shifts in units of ``length``, [..., 6].
        length: unit of the shifts, in the unit of the world.

    Returns:
        Rotation matrices [..., 3, 3], exact to second order in the angles, and shifts [..., 3] in
        the unit of the world.
    """
    turn, shift = motions.split(3, -1)
    return quaternion_to_matrix(torch.cat((torch.ones_like(turn[..., :1]), turn / 2), -1)), length * shift


def motions_between(
    before: Float[Tensor, "V 4 4"], after: Float[Tensor, "V 4 4"], middle: Float[Tensor, "3"]
) -> Float[Tensor, "V 6"]:
    """Small motions of the world about ``middle`` that are equivalent to replacing the extrinsics
    ``before`` by ``after``; the inverse of :func:`apply_motions`.

    Args:
        before: extrinsics [V, 4, 4].
        after: extrinsics [V, 4, 4] that differ by small angles.
        middle: centre of the rotations [3], in the world.

    Returns:
        Rotation vectors in radians, and shifts in the unit of the world, [V, 6].
    """
    back = before[:, :3, :3].mT
    turn = back @ after[:, :3, :3]
    turn = (turn - turn.mT) / 2
    vector = torch.stack((turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]), -1)
    # Differences first: far from the world's origin both terms are large and would cancel.
    seen = (after - before)[:, :3, :3] @ middle + (after - before)[:, :3, 3]
    return torch.cat((vector, (back @ seen[..., None])[..., 0]), -1)


def apply_motions(
    extrinsics: Float[Tensor, "*n 4 4"],
    motions: Float[Tensor, "*n 6"],
    middle: Float[Tensor, "3"],
    length: float = 1.0,
) -> Float[Tensor, "*n 4 4"]:
    """Compose extrinsics with :func:`rigid` motions of the world, applied before them.

    Args:
        extrinsics: world to camera [..., 4, 4].
        motions: rotation vectors in radians, and shifts in units of ``length``, [..., 6].
        middle: centre of the rotations [3], in the world.
        length: unit of the shifts, in the unit of the world.

    Returns:
        Extrinsics [..., 4, 4].
    """
    rotations, shifts = rigid(motions, length)
    moved = extrinsics.clone()
    axes = extrinsics[..., :3, :3]
    moved[..., :3, :3] = axes @ rotations
    moved[..., :3, 3] += (axes - moved[..., :3, :3]) @ middle + (axes @ shifts[..., None])[..., 0]
    return moved
