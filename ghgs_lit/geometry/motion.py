"""Small motions of cameras about the subject, and the part that all cameras share.

Photographs do not tell where a rig as a whole is, nor how far its cameras are from a subject of unknown size:
only motions of cameras beside one another can be seen in them.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.rotations import quaternion_to_matrix

#: Weight of a shift along an optical axis beside one across it, in what cameras share: it shows little, and
#: as much as another focal length.
_ALONG = 0.01


def without_common(
    motions: Float[Tensor, "*b V 6"], axes: Float[Tensor, "*b V 3"]
) -> Float[Tensor, "*b V 6"]:
    """Motions without their mean, and without what they share along the optical axes.

    The mean of the shifts is the one that photographs show least of once it is taken out: least squares of
    what is across the optical axes. ``motions``: rotation vectors of points, and shifts, in the world's axes.
    ``axes``: optical axes of the cameras.
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
    """Rotation matrices, by the vectors up to second order in their angles, and shifts times ``length``."""
    turn, shift = motions.split(3, -1)
    return quaternion_to_matrix(torch.cat((torch.ones_like(turn[..., :1]), turn / 2), -1)), length * shift


def motions_between(
    before: Float[Tensor, "V 4 4"], after: Float[Tensor, "V 4 4"], middle: Float[Tensor, "3"]
) -> Float[Tensor, "V 6"]:
    """Small motions of points about ``middle``: what ``before`` sees after them, ``after`` sees without."""
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
    """Cameras that see points as these see them after :func:`rigid` motions about ``middle``."""
    rotations, shifts = rigid(motions, length)
    moved, axes = extrinsics.clone(), extrinsics[..., :3, :3]
    moved[..., :3, :3] = axes @ rotations
    moved[..., :3, 3] += (axes - moved[..., :3, :3]) @ middle + (axes @ shifts[..., None])[..., 0]
    return moved
