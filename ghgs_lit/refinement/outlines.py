"""Distance maps of one instant's silhouettes, and rays near their outlines: the deepest points of rays
in other silhouettes, and derivatives of these depths."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.frame import HEIGHT
from ghgs_lit.geometry.masks import signed_distance, soft_signed_distance
from ghgs_lit.geometry.projection import pixel_centers, project, sample, unproject, world_to_camera

Lens = Float[Tensor, "V 3 3"]  #: Intrinsics of an instant, in pixels
Pose = Float[Tensor, "V 4 4"]  #: Extrinsics, the same at all instants
Numbers = Int[Tensor, " R"]  #: A silhouette for each ray
Points = Float[Tensor, "R 3"]  #: A point or vector for each ray
_DEPTHS = 48  #: Depths tried along a ray

_FINER = 4  #: Size of the distance maps relative to the images
_FAR = 20.0  #: Distances are clamped to this, in pixels
_FROM = 0.25  #: Least depth inside the outline, in pixels, of rays that are used
TO = 8.0  #: Largest such depth
#: Size of the maps relative to the images, largest depth of rays in pixels, stride over rays.
CAREFUL = (_FINER, TO, 1)
QUICK = (1, 1.5, 2)
_REACH = 0.75  #: Half the step in pixels of finite differences of a distance map


@dataclass(frozen=True)
class Outlines:
    """Signed distances in pixels to the outline of each silhouette, positive inside, and the rays near
    it: ray ``r`` passes through ``pixels[r]`` of silhouette ``view[r]``, ``depth[r]`` pixels inside
    the outline."""

    maps: Float[Tensor, "V 1 h w"]
    view: Int[Tensor, " R"]
    pixels: Float[Tensor, "R 2"]
    depth: Float[Tensor, " R"]
    size: tuple[int, int]
    finer: int = _FINER

    @classmethod
    def of(cls, mattes: Float[Tensor, "V H W"], look: tuple[int, float, int] = CAREFUL) -> "Outlines":
        """Compute the outlines of the silhouettes of one instant.

        Args:
            mattes: [V, H, W] in [0, 1], on a CPU.
            look: size of the maps relative to the mattes, largest depth of rays in pixels, and stride
                over rays.

        Returns:
            Distance maps, and rays in ascending order of silhouettes.
        """
        finer, to, every = look
        size = (mattes.shape[1], mattes.shape[2])
        larger = F.interpolate(mattes[:, None], scale_factor=finer, mode="bilinear", align_corners=False)
        distance = soft_signed_distance if finer == 1 else lambda matte: signed_distance(matte > 0.5)
        maps = torch.from_numpy(np.stack([distance(one) for one in larger[:, 0].numpy()]))[:, None] / finer
        maps = maps.clamp(-_FAR, _FAR).to(mattes)
        view = torch.arange(len(mattes))[:, None, None].expand(-1, *size)
        pixels = pixel_centers(*size, mattes).expand(*view.shape, 2)
        depth = sample(maps, view, finer * pixels)[..., 0]
        near = (depth >= _FROM) & (depth <= to)
        return cls(maps, *(each[near][::every] for each in (view, pixels, depth)), size, finer)

    def of_views(self, kept: Sequence[int]) -> "Outlines":
        """Select silhouettes by ascending indices ``kept``, and renumber them from 0."""
        if len(kept) == len(self.maps):
            return self
        numbers = torch.tensor(kept)
        near = torch.isin(self.view, numbers)
        view = torch.searchsorted(numbers, self.view[near])
        return replace(
            self, maps=self.maps[kept], view=view, pixels=self.pixels[near], depth=self.depth[near]
        )

    def at(self, view: Int[Tensor, "*n"], pixels: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n"]:
        """Signed distances [...] in pixels, positive inside; beyond the image those at its border, since
        a subject may continue there.

        Args:
            view: index of the silhouette of each pixel [...].
            pixels: ``(u, v)`` in the image [..., 2].
        """
        half = 0.5 / self.finer
        within = torch.minimum(pixels.clamp(min=half), pixels.new_tensor(self.size[::-1]) - half)
        return sample(self.maps, view, self.finer * within)[..., 0]

    def along(
        self, view: int, lens: Tensor, pose: Tensor, start: Tensor, ahead: Tensor, depths: Float[Tensor, " D"]
    ) -> Float[Tensor, "R D"]:
        """Signed distances in a silhouette at the points ``start + depth * ahead`` of rays.

        Args:
            view: index of the silhouette.
            lens: its intrinsics [3, 3] in pixels.
            pose: its extrinsics [4, 4].
            start: common origin of the rays [3], in the world.
            ahead: direction of each ray per unit of depth [R, 3].
            depths: depths of the points on each ray [D].

        Returns:
            Distances [R, D] in pixels, positive inside; meaningless behind the camera.
        """
        # Positions in [-1, 1] over the image: ratios of functions that are linear in depth.
        height, width = self.size
        onto = lens.new_tensor([[2 / width, 0, -1], [0, 2 / height, -1], [0, 0, 1]]) @ lens
        first = onto @ (pose[:3, :3] @ start + pose[:3, 3])
        slope = ahead @ (onto @ pose[:3, :3]).mT
        x, y, z = (first[axis] + slope[:, axis, None] * depths for axis in range(3))
        z = torch.where(z > 0, z, 1)
        places = torch.stack((x / z, y / z), -1)[None]
        one = self.maps[view : view + 1]
        return F.grid_sample(one, places, padding_mode="border", align_corners=False)[0, 0]

    def slopes(self, view: Int[Tensor, " n"], pixels: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
        """Gradients of the distances in the image: change per pixel to the right and down [n, 2].

        Args:
            view: index of the silhouette of each pixel [n].
            pixels: ``(u, v)`` [n, 2].
        """
        steps = _REACH * torch.eye(2).to(pixels)
        rises = [self.at(view, pixels + step) - self.at(view, pixels - step) for step in steps]
        return torch.stack(rises, -1) / (2 * _REACH)


def best_points(
    outlines: Outlines, lens: Lens, pose: Pose, view: Numbers, pixels: Float[Tensor, "R 2"]
) -> tuple[Points, Numbers, Float[Tensor, " R"]]:
    """Find the point of each ray that is deepest in the other silhouettes.

    Args:
        outlines: outlines of the silhouettes of one instant.
        lens: its intrinsics.
        pose: extrinsics around the subject's centre.
        view: index of the silhouette of each ray, ascending.
        pixels: pixels that the rays pass through [R, 2].

    Returns:
        Points [R, 3]; the other silhouette in which each is least deep [R]; and its signed depth
        there, in pixels [R].
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
        outlines: outlines of the silhouettes of one instant.
        lens: its intrinsics.
        pose: extrinsics.
        points: one per ray.
        other: index of the silhouette of each distance.

    Returns:
        Vectors [R, 3] in world axes, in pixels per unit of the frame.
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
    """Derivatives of the distances with respect to a camera's motion and zoom: rows of the Jacobian.

    Args:
        points: one per ray, relative to the subject's centre.
        gradients: derivatives with respect to these.
        pose: extrinsics of the camera of each ray [R, 4, 4].
        middle: the subject's centre [3] in the frame.

    Returns:
        [R, 7]: with respect to the rotation vector about the frame's origin, the shift in half
        heights, and the logarithm of the focal length, which moves points away from the optical axis.
    """
    across = world_to_camera(points, pose)[:, :2]
    zoom = ((pose[:, :3, :3] @ gradients[..., None])[:, :2, 0] * across).sum(-1, keepdim=True)
    return torch.cat((torch.linalg.cross(points + middle, gradients), HEIGHT / 2 * gradients, zoom), -1)
