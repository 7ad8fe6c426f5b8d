"""Directions, quaternions ``(w, x, y, z)``, rotation matrices, and small motions of cameras.
Photographs show neither where a rig as a whole is nor how far its cameras are from a subject of
unknown size: they only determine motions of the cameras relative to one another."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.projection import at_least_float32


def quaternion_to_matrix(quaternions: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions of any norm.

    Quaternions are first scaled by their largest component: norms of 1e-30 or 1e30 are valid.

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


#: The 16 values of Shepperd's table as sums of at most four numbers with signs. 0 is the number 1;
#: entries of the matrix are numbered from 1, by row.
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
    """Unit quaternions of rotation matrices (Shepperd 1978).

    Args:
        matrices: proper rotations [..., 3, 3].

    Returns:
        ``(w, x, y, z)`` [..., 4].
    """
    numbers = F.pad(matrices.flatten(-2), (1, 0), value=1.0)
    table = _signed(numbers, _TABLE, _TABLE_SIGNS).sum(-1).unflatten(-1, (4, 4))
    best = table.diagonal(dim1=-2, dim2=-1).argmax(-1)
    chosen = table.gather(-2, best[..., None, None].expand(*best.shape, 1, 4))[..., 0, :]
    return chosen / chosen.norm(dim=-1, keepdim=True)


def _signed(numbers: Float[Tensor, "*batch n"], places: tuple, signs: tuple) -> Float[Tensor, "*batch r 4"]:
    """The numbers at ``places`` (rows of four) times ``signs``."""
    index = constant(torch.tensor, sum(places, ()), like=numbers, dtype=torch.long)
    chosen = numbers.index_select(-1, index).unflatten(-1, (-1, 4))
    return chosen * constant(torch.tensor, signs, like=numbers)


def rotate(
    quaternions: Float[Tensor, "*batch 4"], vectors: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Vectors rotated by quaternions, in a fifth of the time of a product with matrices.

    Args:
        quaternions: ``(w, x, y, z)`` of norm 1 [..., 4].
        vectors: [..., 3].

    Returns:
        Vectors [..., 3].
    """
    axis = quaternions[..., 1:]
    twice = 2 * torch.linalg.cross(axis, vectors)
    return vectors + quaternions[..., :1] * twice + torch.linalg.cross(axis, twice)


#: Components of the second quaternion by which those of the first are multiplied, and signs of the
#: products: for z, y, x and w of the result, in whose order gradients are summed.
_FACTORS = ((3, 2, 1, 0), (2, 3, 0, 1), (1, 0, 3, 2), (0, 1, 2, 3))
_FACTOR_SIGNS = ((1, 1, -1, 1), (1, -1, 1, 1), (1, 1, 1, -1), (1, -1, -1, -1))


def multiply_quaternions(
    first: Float[Tensor, "*#batch 4"], second: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*batch 4"]:
    """The products ``first second``: rotate by ``second``, then by ``first``.

    Args:
        first: ``(w, x, y, z)`` [..., 4] of any norm.
        second: the same.

    Returns:
        Quaternions [..., 4], whose norms are the products of the norms.
    """
    return (first[..., None, :] * _signed(second, _FACTORS, _FACTOR_SIGNS)).sum(-1).flip(-1)


def unit(x: Float[Tensor, "*n c"], least: float = 0.0) -> Float[Tensor, "*n c"]:
    """Vectors divided by their length; 0 stays 0, with a zero gradient.

    Vectors are first scaled by their largest component: squares of 1e-20 vanish in float32, those
    of 1e20 overflow.

    Args:
        x: vectors [..., c].
        least: the gradient, which grows as 1 / length,
            stays constant for vectors shorter than this.

    Returns:
        Vectors [..., c], float32 or wider.
    """
    x = at_least_float32(x)
    largest = torch.linalg.vector_norm(x.detach(), torch.inf, -1, keepdim=True)
    is_zero = largest == 0
    scaled = x / largest.masked_fill(is_zero, 1.0)
    # The argument is replaced, not the result: a root at 0 would have an infinite gradient.
    squared = scaled.square().sum(-1, keepdim=True).masked_fill(is_zero, 1.0)
    direction = scaled * squared.rsqrt()
    if not direction.requires_grad:
        return direction
    direction = direction.masked_fill(is_zero, 0.0)
    if least == 0:
        return direction
    share = (largest * squared.detach().sqrt() / least).clamp(max=1)
    return direction.detach() + share * (direction - direction.detach())


#: Relative weight of a shift along an optical axis: it is hardly visible,
#: much like another focal length.
_ALONG = 0.01


def without_common(
    motions: Float[Tensor, "*b V 6"], axes: Float[Tensor, "*b V 3"]
) -> Float[Tensor, "*b V 6"]:
    """Motions without their mean, and without the mean of their shifts along the optical axes.

    The mean of the shifts leaves the least shifts across the optical axes (least squares).

    Args:
        motions: rotation vectors of points, in radians, and shifts [..., V, 6],
            in the world's axes.
        axes: optical axes of the cameras [..., V, 3], unit vectors of the world.

    Returns:
        Motions [..., V, 6].
    """
    turn, shift = motions.split(3, -1)
    turn = turn - turn.mean(-2, keepdim=True)
    across = torch.eye(3).to(axes) - (1 - _ALONG) * axes[..., :, None] * axes[..., None, :]
    # Products written out: matmul would run in half precision under autocast.
    mean = torch.linalg.solve(across.sum(-3), (across * shift[..., None, :]).sum((-3, -1)))
    shift = shift - mean[..., None, :]
    along = (shift * axes).sum(-1, keepdim=True).mean(-2, keepdim=True)
    return torch.cat((turn, shift - along * axes), -1)


def rigid(
    motions: Float[Tensor, "*n 6"], length: float = 1.0
) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
    """Rotations and shifts of small motions.

    Args:
        motions: rotation vectors in radians, and shifts in units of ``length``, [..., 6].
        length: in the unit of the world.

    Returns:
        Rotation matrices [..., 3, 3], exact to second order in the angles, and shifts [..., 3] in
        the unit of the world.
    """
    turn, shift = motions.split(3, -1)
    return quaternion_to_matrix(torch.cat((torch.ones_like(turn[..., :1]), turn / 2), -1)), length * shift


def motions_between(
    before: Float[Tensor, "V 4 4"], after: Float[Tensor, "V 4 4"], middle: Float[Tensor, "3"]
) -> Float[Tensor, "V 6"]:
    """Small motions about ``middle`` after which ``before`` sees points as ``after``
    sees them unmoved.

    Args:
        before: extrinsics [V, 4, 4].
        after: extrinsics [V, 4, 4] that differ from them by small angles.
        middle: point [3] of the world.

    Returns:
        Rotation vectors in radians, and shifts in the unit of the world, [V, 6].
    """
    back = before[:, :3, :3].mT
    turn = back @ after[:, :3, :3]
    turn = (turn - turn.mT) / 2
    vector = torch.stack((turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]), -1)
    # Differences first: far from the world's origin the two sums are large.
    seen = (after - before)[:, :3, :3] @ middle + (after - before)[:, :3, 3]
    return torch.cat((vector, (back @ seen[..., None])[..., 0]), -1)


def after_motions(
    extrinsics: Float[Tensor, "*n 4 4"],
    motions: Float[Tensor, "*n 6"],
    middle: Float[Tensor, "3"],
    length: float = 1.0,
) -> Float[Tensor, "*n 4 4"]:
    """Cameras that see points as ``extrinsics`` sees them after :func:`rigid` motions.

    Args:
        extrinsics: world to camera [..., 4, 4].
        motions: rotation vectors in radians, and shifts in units of ``length``, [..., 6].
        middle: point [3] of the world that motions turn about.
        length: in the unit of the world.

    Returns:
        Extrinsics [..., 4, 4].
    """
    rotations, shifts = rigid(motions, length)
    moved = extrinsics.clone()
    axes = extrinsics[..., :3, :3]
    moved[..., :3, :3] = axes @ rotations
    moved[..., :3, 3] += (axes - moved[..., :3, :3]) @ middle + (axes @ shifts[..., None])[..., 0]
    return moved
