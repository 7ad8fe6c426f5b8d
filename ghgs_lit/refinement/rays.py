"""Rays of silhouette pixels: their deepest points in other silhouettes,
and derivatives of these depths."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.frame import HEIGHT
from ghgs_lit.geometry.projection import project, unproject, world_to_camera
from ghgs_lit.refinement.outlines import Outlines

Lens = Float[Tensor, "V 3 3"]  #: Intrinsics of an instant, in pixels
Pose = Float[Tensor, "V 4 4"]  #: Extrinsics, the same at all instants
Numbers = Int[Tensor, " R"]  #: A silhouette for each ray
Points = Float[Tensor, "R 3"]  #: A point or vector for each ray
_DEPTHS = 48  #: Depths tried along a ray


def best_points(
    outlines: Outlines, lens: Lens, pose: Pose, view: Numbers, pixels: Float[Tensor, "R 2"]
) -> tuple[Points, Numbers, Float[Tensor, " R"]]:
    """The point of each ray that is deepest in the other silhouettes.

    Args:
        outlines: of the silhouettes of one instant.
        lens: its intrinsics.
        pose: extrinsics around the subject's middle.
        view: the silhouette of each ray, ascending.
        pixels: that the rays pass [R, 2].

    Returns:
        Points [R, 3]; the other silhouette that each is least deep in [R]; and its signed depth in
        that in pixels [R].
    """
    centers = -(pose[:, :3, :3].mT @ pose[:, :3, 3:])[..., 0]
    along = torch.linspace(-HEIGHT / 2, HEIGHT / 2, _DEPTHS).to(pixels)
    views = range(len(pose))
    points = []
    for home in views:
        rays = pixels[view == home]
        ahead = unproject(rays, torch.ones_like(rays[:, 0]), lens[home], pose[home]) - centers[home]
        depths = pose[home, 2, 3] + along
        least = rays.new_full((len(rays), _DEPTHS), torch.inf)
        for one in views:
            if one != home:
                seen = outlines.along(one, lens[one], pose[one], centers[home], ahead, depths)
                least = torch.minimum(least, seen)
        points.append(centers[home] + depths[least.argmax(1)][:, None] * ahead)
    points = torch.cat(points)
    shown = []
    for one in views:
        depth = outlines.at(torch.full_like(view, one), project(points, lens[one], pose[one])[0])
        shown.append(torch.where(view == one, torch.inf, depth))
    depth, other = torch.stack(shown).min(0)
    return points, other, depth


def gradients_of(outlines: Outlines, lens: Lens, pose: Pose, points: Points, other: Numbers) -> Points:
    """Derivatives of the distances with respect to the points.

    Args:
        outlines: of the silhouettes of one instant.
        lens: its intrinsics.
        pose: extrinsics.
        points: one for each ray.
        other: the silhouette that each distance is in.

    Returns:
        Vectors [R, 3] in the world's axes, in pixels per unit of the frame.
    """
    seen, depth = project(points, lens[other], pose[other])
    slopes = outlines.slopes(other, seen) * lens[other][:, [0, 1], [0, 1]]
    inside = world_to_camera(points, pose[other])
    ahead = -(slopes * inside[:, :2]).sum(-1) / depth**2
    in_camera = torch.cat((slopes / depth[:, None], ahead[:, None]), -1)
    return (pose[other, :3, :3].mT @ in_camera[..., None])[..., 0]


def rows_of(
    points: Points, gradients: Points, pose: Float[Tensor, "R 4 4"], middle: Float[Tensor, " 3"]
) -> Float[Tensor, "R 7"]:
    """Derivatives of the distances with respect to a camera's motion and zoom.

    Args:
        points: one for each ray, around the subject's middle.
        gradients: derivatives with respect to these.
        pose: extrinsics of the camera of each ray [R, 4, 4].
        middle: the subject's middle [3] in the frame.

    Returns:
        [R, 7]: by the rotation vector about the frame's origin, the shift in half heights, and the
        logarithm of the focal length, which moves points away from the optical axis.
    """
    across = world_to_camera(points, pose)[:, :2]
    zoom = ((pose[:, :3, :3] @ gradients[..., None])[:, :2, 0] * across).sum(-1, keepdim=True)
    return torch.cat((torch.linalg.cross(points + middle, gradients), HEIGHT / 2 * gradients, zoom), -1)
