"""Between which depths the subject can lie on each input ray, from masks and cameras alone.

``box`` intersects every ray with an axis-aligned box around the subject, found by carving a coarse
grid with the masks. ``hull`` marches the rays of the subject's pixels through that box and keeps
what the masks of the *other* views allow: the image-based visual hull (Matusik et al. 2000). Not
part of the paper; see ``depth_head.bounds``. Masks are dilated, because real ones are noisy, and
searched at a bounded resolution, so that the cost hardly depends on the size of the images.

A ray is a function of z-depth: ``point(z) = center + z * direction``. Nothing here has a gradient.
"""

from dataclasses import dataclass
from math import ceil

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.projection import at_least_float32, pixel_centers, project, world_to_camera
from ghgs_lit.types import Cameras

Interval = tuple[Tensor, Tensor]

#: The depth below which a point counts as behind its camera when masks are looked up, in metres.
_BEHIND = 1e-4

#: No bound lies beyond, in metres: cameras of absurd sizes overflow.
_FARTHEST = 1e6


@dataclass(frozen=True)
class SubjectBounds:
    """Near and far of each pixel: ``bounds(masks, cameras) -> near, far``, each [B, V, H, W] in metres.

    ``kind``: ``box`` or ``hull``. ``dilation``: of the masks, as a part of the image's longer side.
    ``tolerance``: a point stays inside when at most so many other views that see it say outside.
    ``samples``: on each ray. ``resolution``: longer side, in cells, of the masks that are searched.
    ``cells``: side of the grid that is carved for the box. ``margin``: around the box, in metres.
    ``min_depth`` and ``min_thickness``: bounds of ``near`` and of ``far - near``, in metres.

    Views with an empty mask do not vote. A ray that misses the hull gets its interval in the box,
    one that misses the box gets the range of depths of the whole box.
    """

    kind: str = "hull"
    dilation: float = 0.02
    tolerance: int = 0
    samples: int = 48
    resolution: int = 160
    cells: int = 32
    margin: float = 0.03
    min_depth: float = 0.1
    min_thickness: float = 0.02

    def __post_init__(self) -> None:
        choice("depth_head.search.kind", self.kind, ("box", "hull"))
        require(0 <= self.dilation < 0.5, "depth_head.search.dilation", "a part of the image", self.dilation)
        for name in ("tolerance", "margin"):
            require(getattr(self, name) >= 0, f"depth_head.search.{name}", "0 or more", getattr(self, name))
        for name, least in (("samples", 2), ("resolution", 8), ("cells", 8)):
            value = getattr(self, name)
            require(value >= least, f"depth_head.search.{name}", f"{least} or more", value)
        for name in ("min_depth", "min_thickness"):
            require(getattr(self, name) > 0, f"depth_head.search.{name}", "above 0", getattr(self, name))

    @torch.no_grad()
    def __call__(
        self, masks: Bool[Tensor, "B V H W"], cameras: Cameras
    ) -> tuple[Float[Tensor, "B V H W"], Float[Tensor, "B V H W"]]:
        with torch.autocast(masks.device.type, enabled=False):
            stride = ceil(max(masks.shape[-2:]) / self.resolution)
            cells = _shrink(masks, stride)
            radius = ceil(self.dilation * max(cells.shape[-2:]))
            coarse = _scaled(cameras, stride, cells)
            lower, upper = subject_box(cells, coarse, radius, self.tolerance, self.cells)
            lower, upper = lower - self.margin, upper + self.margin
            near, far = self._positive(*box_interval(cameras, lower, upper))
            if self.kind == "box":
                return near, far
            start = (near, far) if stride == 1 else self._positive(*box_interval(coarse, lower, upper))
            # One cell at least: the rays of a cell's pixels run beside the ray of its centre.
            found = hull_interval(
                cells, coarse, *start, max(radius, 1), tolerance=self.tolerance, samples=self.samples
            )
            near_hull, far_hull = (_enlarge(value, stride, masks.shape[-2:]) for value in found)
            return self._positive(torch.maximum(near, near_hull), torch.minimum(far, far_hull))

    def _positive(self, near: Tensor, far: Tensor) -> Interval:
        """Intervals before the camera and at least ``min_thickness`` long, widened about their middle."""
        near, far = (
            near.nan_to_num(nan=0.0).clamp(max=_FARTHEST),
            far.nan_to_num(nan=0.0).clamp(max=_FARTHEST),
        )
        lack = (self.min_thickness - (far - near)).clamp(min=0) / 2
        near = (near - lack).clamp(min=self.min_depth)
        return near, torch.maximum(far + lack, near + self.min_thickness)


def subject_box(
    masks: Bool[Tensor, "B V h w"], cameras: Cameras, radius: int, tolerance: int = 0, cells: int = 32
) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B 3"]]:
    """The axis-aligned box of what masks (dilated by ``radius`` pixels) and cameras leave of space.

    Carved twice: the second grid fills the box that the first has found. Where nothing is left (masks
    that contradict one another) the box of the pass before stays.
    """
    center = _center(masks, cameras)
    reach = _reach(masks, cameras, center)[:, None]
    lower, upper = center - reach, center + reach
    votes = masks.flatten(2).any(-1)
    focal = at_least_float32(cameras.intrinsics)[..., [0, 1], [0, 1]].amax(-1)
    for _ in range(2):
        cell = (upper - lower) / cells
        depth = _project_one((lower + upper) / 2, cameras)[1]
        # Half a cell's diagonal in pixels, for subjects that come up to 0.6 of the distance of their middle.
        pixels = focal * cell.norm(dim=-1, keepdim=True) / 2 / (0.6 * depth).clamp(min=_BEHIND)
        grow = pixels.nan_to_num(nan=0.0).amax(1).clamp(max=max(masks.shape[-2:])).ceil().int().tolist()
        grown = torch.stack([dilate(mask, radius + more) for mask, more in zip(masks, grow, strict=True)])
        kept = _carve(_outside(grown, votes), cameras, lower, cell, cells, tolerance)
        found = kept.flatten(1).any(-1)[:, None]
        for axis in range(3):
            others = [d for d in (1, 2, 3) if d != axis + 1]
            line = kept.any(others[1]).any(others[0])
            index = torch.arange(cells, device=masks.device).expand_as(line)
            first = torch.where(line, index, cells).amin(-1)
            last = torch.where(line, index, -1).amax(-1)
            low = lower[:, axis] + first * cell[:, axis]
            high = lower[:, axis] + (last + 1) * cell[:, axis]
            lower = torch.where(found & _axis(axis, lower), low[:, None], lower)
            upper = torch.where(found & _axis(axis, upper), high[:, None], upper)
    return lower, upper


def box_interval(
    cameras: Cameras, lower: Float[Tensor, "B 3"], upper: Float[Tensor, "B 3"]
) -> tuple[Float[Tensor, "B V h w"], Float[Tensor, "B V h w"]]:
    """Depths at which the ray of each pixel enters and leaves a box; the box's range where it misses."""
    directions = _directions(cameras)
    centers = cameras.centers[:, :, None, None]
    # A ray along a face: 1e-12 in its place gives the right infinities without 0 / 0.
    directions = torch.where(directions.abs() < 1e-12, 1e-12, directions)
    faces = [(face[:, None, None, None] - centers) / directions for face in (lower, upper)]
    near = torch.minimum(*faces).amax(-1)
    far = torch.maximum(*faces).amin(-1)
    corners = torch.stack(torch.meshgrid(*[torch.arange(2, device=lower.device)] * 3, indexing="ij"), -1)
    corners = torch.where(corners.reshape(1, 8, 3) == 0, lower[:, None], upper[:, None])
    corners = corners[:, None].expand(-1, cameras.shape[1], -1, -1)
    depth = world_to_camera(corners, cameras.extrinsics[:, :, None])[..., 2]
    misses = near >= far
    near = torch.where(misses, depth.amin(-1)[..., None, None], near)
    return near, torch.where(misses, depth.amax(-1)[..., None, None], far)


def hull_interval(
    masks: Bool[Tensor, "B V h w"],
    cameras: Cameras,
    near: Float[Tensor, "B V h w"],
    far: Float[Tensor, "B V h w"],
    radius: int,
    tolerance: int = 0,
    samples: int = 48,
) -> tuple[Float[Tensor, "B V h w"], Float[Tensor, "B V h w"]]:
    """First and last depth in ``[near, far]`` that the dilated masks of the other views allow.

    Computed for the pixels of the subject; others, and rays that miss the hull, keep their interval.
    """
    tables = _outside(dilate(masks, radius), masks.flatten(2).any(-1))
    near, far = near.clone(), far.clone()
    steps = (torch.arange(samples, device=near.device, dtype=near.dtype) + 0.5) / samples
    directions, centers = _directions(cameras), cameras.centers
    projections = _projection_matrices(cameras)
    for b in range(masks.shape[0]):
        for v in range(masks.shape[1]):
            rays = masks[b, v].nonzero(as_tuple=True)
            start, length = near[b, v][rays], (far - near)[b, v][rays]
            depth = start[:, None] + steps * length[:, None]
            outside = torch.zeros(depth.shape, dtype=torch.uint8, device=depth.device)
            for u in range(masks.shape[1]):
                if u != v:
                    along = (projections[b, u, :, :3] * directions[b, v][rays][:, None]).sum(-1)
                    origin = (projections[b, u, :, :3] * centers[b, v]).sum(-1) + projections[b, u, :, 3]
                    pixel = [torch.addcmul(origin[i], depth, along[:, i, None]) for i in range(3)]
                    outside += _look_up(tables[b, u], *pixel)
            inside = (outside <= tolerance).to(torch.uint8)
            hit = inside.amax(1).bool()
            half = length / (2 * samples)
            first = depth.gather(1, inside.argmax(1, keepdim=True))[:, 0] - half
            last = depth.gather(1, samples - 1 - inside.flip(1).argmax(1, keepdim=True))[:, 0] + half
            near[b, v][rays] = torch.where(hit, first, start)
            far[b, v][rays] = torch.where(hit, last, start + length)
    return near, far


def dilate(masks: Bool[Tensor, "*batch h w"], radius: int) -> Bool[Tensor, "*batch h w"]:
    """Masks grown by ``radius`` pixels along both axes (at a cost that does not depend on it)."""
    grown = masks
    for dim in (-2, -1):
        size = masks.shape[dim]
        index = torch.arange(size, device=masks.device)
        counts = F.pad(grown.cumsum(dim, dtype=torch.int32), (0, 0, 1, 0) if dim == -2 else (1, 0))
        high = counts.index_select(dim, (index + radius + 1).clamp(max=size))
        grown = high > counts.index_select(dim, (index - radius).clamp(min=0))
    return grown


def _axis(axis: int, like: Tensor) -> Tensor:
    return torch.arange(like.shape[-1], device=like.device) == axis


def _shrink(masks: Tensor, stride: int) -> Tensor:
    """Cells of ``stride`` x ``stride`` pixels with any pixel of the subject; the last may be cut off."""
    if stride == 1:
        return masks
    return F.max_pool2d(masks.float(), stride, stride, ceil_mode=True).bool()


def _enlarge(values: Tensor, stride: int, size: tuple[int, int]) -> Tensor:
    values = values.repeat_interleave(stride, -2).repeat_interleave(stride, -1)
    return values[..., : size[0], : size[1]]


def _scaled(cameras: Cameras, stride: int, cells: Tensor) -> Cameras:
    """The cameras of the cells. Not ``resized``: the last row and column may stick out of the image."""
    height, width = cells.shape[-2:]
    full = Cameras(
        at_least_float32(cameras.intrinsics),
        at_least_float32(cameras.extrinsics),
        height * stride,
        width * stride,
    )
    return full.resized(height, width)


def _directions(cameras: Cameras) -> Float[Tensor, "*batch h w 3"]:
    """World displacement of each pixel's ray per metre of z-depth."""
    intrinsics, extrinsics = at_least_float32(cameras.intrinsics), at_least_float32(cameras.extrinsics)
    centers = pixel_centers(cameras.height, cameras.width, intrinsics)
    centers = torch.cat((centers, torch.ones_like(centers[..., :1])), dim=-1)
    to_world = extrinsics[..., :3, :3].mT @ torch.linalg.inv(intrinsics)
    return torch.einsum("...ij,hwj->...hwi", to_world, centers)


def _projection_matrices(cameras: Cameras) -> Float[Tensor, "*batch 3 4"]:
    return at_least_float32(cameras.intrinsics) @ at_least_float32(cameras.extrinsics)[..., :3, :]


def _outside(masks: Tensor, votes: Tensor) -> Tensor:
    """1 where a voting view says outside."""
    return (~masks & votes[..., None, None]).to(torch.uint8)


def _look_up(table: Tensor, x: Tensor, y: Tensor, w: Tensor) -> Tensor:
    """Entries of one table [h, w] at homogeneous pixels; the inputs are overwritten.

    Points out of the frame take the entry of the nearest border pixel: a mask that does not touch the
    border has the whole subject in its frame. Points behind the camera are thrown far out of it.
    """
    height, width = table.shape
    inverse = w.clamp_(min=_BEHIND).reciprocal_()
    # Cameras of absurd sizes overflow to NaN, which has no index.
    column = x.mul_(inverse).nan_to_num_().clamp_(0, width - 1).int()
    row = y.mul_(inverse).nan_to_num_().clamp_(0, height - 1).int()
    return table.flatten().take(row.mul_(width).add_(column).long())


def _carve(
    tables: Tensor, cameras: Cameras, lower: Tensor, cell: Tensor, cells: int, tolerance: int
) -> Bool[Tensor, "B n n n"]:
    """Which cells of a grid at most ``tolerance`` views say no to."""
    steps = torch.arange(cells, device=lower.device, dtype=lower.dtype) + 0.5
    position = lower[..., None] + cell[..., None] * steps
    matrices = _projection_matrices(cameras)
    kept = []
    for b in range(tables.shape[0]):
        outside = torch.zeros(3 * (cells,), dtype=torch.uint8, device=lower.device)
        for v in range(tables.shape[1]):
            x, y, z = (matrices[b, v, :, axis, None] * position[b, axis] for axis in range(3))
            z = z + matrices[b, v, :, 3, None]
            pixel = (x[:, :, None] + y[:, None, :])[..., None] + z[:, None, None, :]
            outside += _look_up(tables[b, v], *pixel.unbind(0))
        kept.append(outside <= tolerance)
    return torch.stack(kept)


def _project_one(points: Float[Tensor, "B 3"], cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Pixel [B, V, 2] and depth [B, V] of one point of each element in all of its cameras."""
    points = points[:, None].expand(*cameras.shape, 3)
    return project(points, cameras.intrinsics, cameras.extrinsics)


def _center(masks: Bool[Tensor, "B V h w"], cameras: Cameras) -> Float[Tensor, "B 3"]:
    """The point nearest to the rays through the masks' centroids, by least squares.

    The optical axes take part with a small weight, so that one mask, or none, is enough; a still smaller
    pull to the cameras keeps parallel rays solvable.
    """
    intrinsics, extrinsics = at_least_float32(cameras.intrinsics), at_least_float32(cameras.extrinsics)
    u, v = _axes(cameras)
    counts = masks.sum((-2, -1))
    sums = torch.stack(((masks.sum(-2) * u).sum(-1), (masks.sum(-1) * v).sum(-1)), -1)
    axis = intrinsics[..., :2, 2]
    centroid = torch.where(counts[..., None] > 0, sums / counts.clamp(min=1)[..., None], axis)
    rays = torch.stack((centroid, axis), dim=-2)
    rays = torch.cat((rays, torch.ones_like(rays[..., :1])), -1)
    to_world = extrinsics[..., :3, :3].mT @ torch.linalg.inv(intrinsics)
    directions = F.normalize(torch.einsum("bvij,bvrj->bvri", to_world, rays), dim=-1)
    weights = torch.stack((counts > 0, torch.full_like(counts, 1e-3, dtype=rays.dtype)), -1)
    identity = torch.eye(3, device=rays.device, dtype=rays.dtype)
    across = identity - directions[..., :, None] * directions[..., None, :]
    across = (weights[..., None, None] * across).sum(2)
    origin = cameras.centers.mean(1)
    offsets = (cameras.centers - origin[:, None])[..., None]
    matrix = across.sum(1) + 1e-4 * identity
    return torch.linalg.solve(matrix, (across @ offsets).sum(1))[..., 0] + origin


def _reach(masks: Bool[Tensor, "B V h w"], cameras: Cameras, center: Float[Tensor, "B 3"]) -> Tensor:
    """A generous radius of the subject about ``center``, in metres."""
    pixel, depth = _project_one(center, cameras)
    extents = [
        torch.where(masks.any(-2 + dim), (line - pixel[..., dim, None]).abs() + 0.5, 0).amax(-1)
        for dim, line in enumerate(_axes(cameras))
    ]
    extent = torch.stack(extents, -1) / at_least_float32(cameras.intrinsics)[..., [0, 1], [0, 1]]
    # More than what is seen: what reaches away from a camera looks smaller than it is.
    return 1.4 * (extent.norm(dim=-1) * depth.clamp(min=_BEHIND)).amax(1).clamp(min=0.05)


def _axes(cameras: Cameras) -> tuple[Tensor, Tensor]:
    """Pixel centres along a row and along a column."""
    centers = pixel_centers(cameras.height, cameras.width, at_least_float32(cameras.intrinsics))
    return centers[0, :, 0], centers[:, 0, 1]
