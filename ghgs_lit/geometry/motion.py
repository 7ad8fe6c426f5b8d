"""Small motions of cameras about the subject, and the part that all cameras share.

Photographs do not tell where a rig as a whole is, nor how far its cameras are from a subject of unknown size:
only motions of cameras beside one another can be seen in them.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.rotations import quaternion_to_matrix


def without_common(
    motions: Float[Tensor, "*b V 6"], axes: Float[Tensor, "*b V 3"]
) -> Float[Tensor, "*b V 6"]:
    """Motions without their mean, and without what they share along the optical axes.

    Args:
        motions: rotation vectors of points, and shifts, in the world's axes.
        axes: optical axes of the cameras.
    """
    turn, shift = (motions - motions.mean(-2, keepdim=True)).split(3, -1)
    along = (shift * axes).sum(-1, keepdim=True).mean(-2, keepdim=True)
    return torch.cat((turn, shift - along * axes), -1)


def rigid(
    motions: Float[Tensor, "*n 6"], length: float = 1.0
) -> tuple[Float[Tensor, "*n 3 3"], Float[Tensor, "*n 3"]]:
    """Rotations, which are exact rotations up to small angles' vectors, and shifts times ``length``."""
    turn, shift = motions.split(3, -1)
    return quaternion_to_matrix(torch.cat((torch.ones_like(turn[..., :1]), turn / 2), -1)), length * shift
