"""Coordinate frame of the subject, in which stages work: metres, upright, subject at the origin.

The world of a capture has any unit and origin. In float32 an origin 1 km away costs 0.1 mm, limits
in metres are meaningless in a world in millimetres, and an axis-aligned box depends on the world's
axes. So a rigid motion and a scale, both in float64, take the cameras of a batch into the frame and
its prediction back to the world. :meth:`Frame.of` and :meth:`Frame.enter` have no gradient."""

import dataclasses
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.masks import first_and_last
from ghgs_lit.geometry.projection import (
    at_least_float32,
    homogeneous_centers,
    inverse_intrinsics,
    world_to_camera,
)
from ghgs_lit.geometry.rotations import matrix_to_quaternion, multiply_quaternions, unit
from ghgs_lit.types import Batch, Cameras, DepthBounds, DepthMaps, Gaussians, Prediction

#: Height of the subject in its frame, or its width if larger, in metres.
HEIGHT = 1.8


@dataclass(frozen=True)
class Frame:
    """Frame of each element: ``world = origin + metre * axes^T point``, in float64.

    Attributes:
        origin: the subject's centre in the world.
        axes: rows are right, up (mean of all cameras) and back of the first camera.
        metre: length of the frame's metre in the world's unit.
    """

    origin: Float[Tensor, "B 3"]
    axes: Float[Tensor, "B 3 3"]
    metre: Float[Tensor, " B"]

    @classmethod
    @torch.no_grad()
    def of(cls, batch: Batch) -> "Frame":
        """Compute the frame of each element from its masks and cameras."""
        # Autocast and TF32 leave float64 products as they are.
        matrices = (batch.cameras.intrinsics.double(), batch.cameras.extrinsics.double())
        cameras = Cameras(*matrices, batch.cameras.height, batch.cameras.width)
        origin = subject_center(batch.masks, cameras)
        return cls(origin, _axes(cameras), _size(batch.masks, cameras, origin) / HEIGHT)

    @property
    def shared(self) -> "Frame":
        """One frame for all elements, which must share a world: mean origin, first axes, median
        metre."""
        one = (self.origin.mean(0), self.axes[0], self.metre.median())
        return Frame(*(each.expand(len(self.metre), *each.shape) for each in one))

    @torch.no_grad()
    def enter(self, batch: Batch) -> Batch:
        """Move the input cameras of a batch from the world into the frame.

        Targets, true depths and bodies stay in the world. The cameras returned have the dtype of
        the images, float32 or wider.
        """
        cameras = batch.cameras
        dtype = at_least_float32(batch.images).dtype
        extrinsics = cameras.extrinsics.double()
        moved = extrinsics.clone()
        moved[..., :3, :3] = extrinsics[..., :3, :3] @ self.axes[:, None].mT
        moved[..., :3, 3] = in_cameras(self.origin, extrinsics) / self.metre[:, None, None]
        inside = Cameras(cameras.intrinsics.to(dtype), moved.to(dtype), cameras.height, cameras.width)
        return dataclasses.replace(batch, cameras=inside)

    def leave_cameras(self, inside: Cameras, world: Cameras) -> Cameras:
        """Move cameras from the frame to the world.

        Args:
            inside: cameras in the frame, extrinsics [B, V, 4, 4].
            world: the original cameras, whose dtypes the result has.
        """
        extrinsics = world.extrinsics.double().clone()
        extrinsics[..., :3, :3] = inside.extrinsics[..., :3, :3].double() @ self.axes[:, None]
        to_origin = (extrinsics[..., :3, :3] @ self.origin[:, None, :, None])[..., 0]
        extrinsics[..., :3, 3] = (
            inside.extrinsics[..., :3, 3].double() * self.metre[:, None, None] - to_origin
        )
        intrinsics = inside.intrinsics.to(world.intrinsics)
        return dataclasses.replace(world, intrinsics=intrinsics, extrinsics=extrinsics.to(world.extrinsics))

    def in_world(self, dtype: torch.dtype) -> Float[Tensor, "B 4 3"]:
        """Axes of each element in the world, one metre long, and its origin, as four rows."""
        return torch.cat((self.metre[:, None, None] * self.axes, self.origin[:, None]), 1).to(dtype)

    def leave(self, prediction: Prediction, dtype: torch.dtype) -> Prediction:
        """Move a prediction from the frame to the world, in its unit and axes.

        Args:
            prediction: in the frame.
            dtype: dtype of points in the world (that of its cameras), float32 or wider: far from
                the origin points need more digits.
        """
        dtype = torch.promote_types(dtype, torch.float32)
        views = prediction.depth.shape[1]
        points = prediction.points
        everyone = constant(torch.arange, len(self.metre), like=points.pixels, dtype=torch.long)
        known: dict[Tensor, Tensor] = {}
        metre = self.metre.to(prediction.depth)[:, None, None, None]
        maps = _scale_maps(prediction.depth_maps, metre, known)
        world = self.in_world(dtype)
        return dataclasses.replace(
            prediction,
            gaussians=self._gaussians(prediction.gaussians, views, world),
            depth=maps.depth,
            points=dataclasses.replace(
                points,
                pixels=to_world(points.pixels, everyone[:, None, None, None], world),
                tokens=to_world(points.tokens, points.token_image // views, world),
            ),
            depth_maps=maps,
            rounds=tuple(_scale_maps(each_round, metre, known) for each_round in prediction.rounds),
        )

    def _gaussians(self, gaussians: Gaussians, views: int, world: Tensor) -> Gaussians:
        element = gaussians.image // views
        lengths = self.metre.to(gaussians.scales)
        turn = matrix_to_quaternion(self.axes.mT).to(gaussians.quaternions)
        return dataclasses.replace(
            gaussians,
            means=to_world(gaussians.means, element, world),
            quaternions=multiply_quaternions(turn[element], gaussians.quaternions),
            scales=gaussians.scales * lengths[element, None],
            metre=lengths if gaussians.metre is None else lengths * gaussians.metre,
        )


def _scale_maps(maps: DepthMaps, metre: Float[Tensor, "B 1 1 1"], known: dict[Tensor, Tensor]) -> DepthMaps:
    """Scale depth maps to the world's unit; ``known`` caches results, since rounds share bounds."""

    def scale(depth: Tensor) -> Tensor:
        if depth not in known:
            known[depth] = depth * metre
        return known[depth]

    bounds = maps.bounds and DepthBounds(scale(maps.bounds.near), scale(maps.bounds.far))
    return dataclasses.replace(maps, depth=scale(maps.depth), bounds=bounds)


def to_world(
    points: Float[Tensor, "*n 3"], element: Int[Tensor, "*#n"], world: Float[Tensor, "B 4 3"]
) -> Float[Tensor, "*n 3"]:
    """Move points from the frame to the world, in the dtype of ``world``, with no error but that of
    rounding the result.

    Args:
        points: [..., 3] in the frame.
        element: batch element of each point, of a shape that broadcasts with [...].
        world: :meth:`Frame.in_world` [B, 4, 3].
    """
    *axes, result = world[element].unbind(-2)
    for coordinate, axis in zip(points.to(world.dtype)[..., None].unbind(-2), axes, strict=True):
        result = torch.addcmul(result, coordinate, axis)
    return result


def subject_center(masks: Bool[Tensor, "B V h w"], cameras: Cameras) -> Float[Tensor, "B 3"]:
    """Least-squares intersection of the rays through the masks' centroids.

    Optical axes enter with a small weight, so that one mask or none is enough, and the mean of the
    camera centres with a smaller one, for parallel rays. Call it under
    :func:`ghgs_lit.geometry.precision.exact`.

    Args:
        masks: of the subject [B, V, h, w].
        cameras: [B, V], of images of that size.

    Returns:
        Points [B, 3] in the world.
    """
    intrinsics = at_least_float32(cameras.intrinsics)
    extrinsics = at_least_float32(cameras.extrinsics)
    # Sums of u and v, and the number of pixels: half-integers, whose sums are exact in any order.
    centers = homogeneous_centers(*masks.shape[2:], intrinsics).flatten(0, 1)
    sums, counts = (masks.flatten(-2).to(centers.dtype) @ centers).split((2, 1), -1)
    axis = intrinsics[..., :2, 2]
    is_seen = counts > 0
    centroid = torch.where(is_seen, sums / counts.clamp(min=1), axis)
    rays = F.pad(torch.stack((centroid, axis), dim=-2), (0, 1), value=1.0)
    to_world = extrinsics[..., :3, :3].mT @ inverse_intrinsics(intrinsics)
    directions = unit(torch.einsum("bvij,bvrj->bvri", to_world, rays))
    weights = F.pad(is_seen.to(rays.dtype), (0, 1), value=1e-3)
    identity = constant(torch.eye, 3, like=rays)
    across = identity - directions[..., :, None] * directions[..., None, :]
    across = (weights[..., None, None] * across).sum(2)
    centers = cameras.centers
    origin = centers.mean(1)
    offsets = (centers - origin[:, None])[..., None]
    matrix = torch.add(across.sum(1), identity, alpha=1e-4)
    # Never singular; linalg.solve would check that with a device-to-host synchronisation.
    return torch.linalg.solve_ex(matrix, (across @ offsets).sum(1)).result[..., 0] + origin


@torch.no_grad()
def places_around(
    points: Float[Tensor, "*b n 3"], is_subject: Bool[Tensor, "*b n"]
) -> Float[Tensor, "*b n 3"]:
    """Positions of tokens relative to the subject's centre, in units of its size.

    The centre is the mean of the subject's points and the unit their root mean square distance from
    it: positions depend neither on the world's origin nor on its unit.

    Args:
        points: points of an element's tokens, or of several elements with the same number.
        is_subject: which points lie on the subject; these define centre and unit.

    Returns:
        Positions, float32 or wider; 0 for points that are not finite, and if all points of the
        subject coincide.
    """
    points = at_least_float32(points)
    is_finite = points.isfinite().all(-1)
    weights = (is_subject & is_finite).to(points.dtype)
    weights = (weights / weights.sum(-1, keepdim=True).clamp(min=1))[..., None]
    points = torch.where(is_finite[..., None], points, 0)
    middle = (weights * points).sum(-2, keepdim=True)
    around = torch.where(is_finite[..., None], points - middle, 0)
    unit_length = (weights * around.square()).sum((-2, -1), keepdim=True).sqrt()
    return around / torch.where(unit_length > 0, unit_length, torch.inf)


def in_cameras(points: Float[Tensor, "B 3"], extrinsics: Float[Tensor, "B V 4 4"]) -> Float[Tensor, "B V 3"]:
    """One point of each element in the coordinates of each of its cameras."""
    return world_to_camera(points[:, None].expand(*extrinsics.shape[:2], 3), extrinsics)


def _size(masks: Bool[Tensor, "B V h w"], cameras: Cameras, center: Tensor) -> Float[Tensor, " B"]:
    """Median over views of the subject's height or width (the larger) in the world's unit;
    :data:`HEIGHT` if no view shows it in front of the camera.

    The median tolerates one wrong mask; of two views the larger size counts, since masks are more
    often too small than too large."""
    depth = in_cameras(center, cameras.extrinsics)[..., 2]
    sides = []
    for axis in (0, 1):
        first, last = first_and_last(masks.any(axis - 2))
        sides.append((last - first + 1) / cameras.intrinsics[..., axis, axis])
    known = masks.flatten(2).any(-1) & (depth > 0)
    sizes = torch.where(known, torch.maximum(*sides) * depth, torch.nan).sort(-1).values
    size = sizes.gather(1, known.sum(-1, keepdim=True) // 2 % sizes.shape[1])[:, 0]
    return torch.where(size > 0, size, HEIGHT)


def _axes(cameras: Cameras) -> Float[Tensor, "B 3 3"]:
    """Right, up and back as rows, a proper rotation for any extrinsics."""
    down = cameras.extrinsics[..., 1, :3]
    forward = cameras.extrinsics[:, 0, 2, :3]
    mean = -down.mean(1)
    # Without a common up direction: that of the first camera.
    up = unit(torch.where(mean.norm(dim=-1, keepdim=True) > 0.1, mean, -down[:, 0]))

    # Project onto the horizontal plane. If the first camera looks straight up or down, its up axis
    # lies in that plane.
    both = -torch.stack((forward, down[:, 0]))
    back, other = both - (both * up).sum(-1, keepdim=True) * up
    back = unit(torch.where(back.norm(dim=-1, keepdim=True) > 0.1, back, other))
    right = unit(torch.linalg.cross(up, back))
    axes = torch.stack((right, up, back), dim=1)
    # Extrinsics of rank 1 or less define no axes.
    known = (right.norm(dim=-1) > 0)[:, None, None]
    return torch.where(known, axes, constant(torch.eye, 3, like=axes))
