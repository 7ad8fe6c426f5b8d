"""Flicker: the change of a render's error from one instant to the next.

The literature measures how frames change along an estimated optical flow (warping error: Lai et al.
2018, Learning Blind Video Temporal Consistency) or unlike the true video (tOF, tLP: Chu et al.
2020, TecoGAN). Here the motion of the surface is known and the true image subtracted: an error that
moves with the surface does not flicker. A black render has the flicker of the photographs."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.projection import project, sample
from ghgs_lit.metrics.regions import box_of
from ghgs_lit.types import Cameras

#: Largest distance in metres of a visible point from the depth map.
VISIBLE = 0.005


def flicker(
    errors: Float[Tensor, "2 t c h w"],
    points: Float[Tensor, "2 n 3"],
    depths: Float[Tensor, "2 t h w"],
    cameras: Cameras,
) -> Float[Tensor, " t"]:
    """Mean absolute change of each camera's error at the points visible at both instants.

    Args:
        errors: renders minus photographs, of images in [0, 1].
        points: of the surface at both instants, in the world, in metres.
        depths: true z-depths in metres, 0 where there is none.
        cameras: [2, t].

    Returns:
        A value for each camera, in units of the images; nan if no point is visible."""
    pixels, z = project(points[:, None], cameras.intrinsics[:, :, None], cameras.extrinsics[:, :, None])
    image = torch.arange(2 * z.shape[1], device=z.device).view(2, -1, 1).expand(z.shape)
    # Beside the silhouette the 0 of the background makes the depth too small:
    # such points are left out.
    off = sample(depths.flatten(0, 1)[:, None], image, pixels)[..., 0] - z
    seen = ((z > 0) & (off.abs() < VISIBLE)).all(0)
    before, after = sample(errors.flatten(0, 1), image, pixels)
    change = torch.where(seen, (after - before).abs().mean(-1), 0)
    return change.sum(-1) / seen.sum(-1)


def flicker_in_place(
    errors: Float[Tensor, "2 t c h w"], masks: Bool[Tensor, "2 t h w"]
) -> Float[Tensor, " t"]:
    """Mean absolute change of each camera's error in the box around both instants' masks.

    No truth but the photographs is needed.

    Args:
        errors: renders minus photographs, of images in [0, 1], by cameras that stand still.
        masks: of the subject.

    Returns:
        A value for each camera, in units of the images; nan if the box is empty."""
    box = box_of(masks.any(0))
    change = torch.where(box, (errors[1] - errors[0]).abs().mean(1), 0)
    return change.sum((1, 2)) / box.sum((1, 2))
