"""Projection, unprojection and bilinear sampling, with the conventions of :mod:`ghgs_lit.types`.

Functions accept any leading dimensions and compute in float32 or wider under any autocast."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.types import Cameras


def at_least_float32(tensor: Tensor) -> Tensor:
    """Return ``tensor`` in float32 or wider, the precision of all geometry."""
    return tensor if tensor.dtype in (torch.float32, torch.float64) else tensor.float()


def pixel_centers(height: int, width: int, like: Tensor) -> Float[Tensor, "h w 2"]:
    """Centres ``(u, v)`` of an image's pixels [h, w, 2], with the device and the dtype of ``like``.

    The tensor is shared (:func:`ghgs_lit.geometry.constants.constant`): never change it in place.
    """
    return homogeneous_centers(height, width, like)[..., :2]


def homogeneous_centers(height: int, width: int, like: Tensor) -> Float[Tensor, "h w 3"]:
    """:func:`pixel_centers` in homogeneous coordinates ``(u, v, 1)`` [h, w, 3]; shared as well."""
    return constant(_centers, height, width, like=like)


def _centers(height: int, width: int, **kind: object) -> Tensor:
    v, u = torch.meshgrid(*(torch.arange(side, **kind) + 0.5 for side in (height, width)), indexing="ij")
    return torch.stack((u, v, torch.ones_like(u)), dim=-1)


def inverse_intrinsics(intrinsics: Float[Tensor, "*batch 3 3"]) -> Float[Tensor, "*batch 3 3"]:
    """``K^-1`` by substitution.

    Args:
        intrinsics: upper triangular matrices K [..., 3, 3] in pixels; a skew is allowed.

    Returns:
        Matrices [..., 3, 3], float32 or wider.
    """
    intrinsics = at_least_float32(intrinsics)
    identity = constant(torch.eye, 3, like=intrinsics)
    return torch.linalg.solve_triangular(intrinsics, identity.expand_as(intrinsics), upper=True)


def unproject(
    pixels: Float[Tensor, "*batch 2"],
    depth: Float[Tensor, "*batch"],
    intrinsics: Float[Tensor, "*#batch 3 3"],
    extrinsics: Float[Tensor, "*#batch 4 4"],
) -> Float[Tensor, "*batch 3"]:
    """World points of pixels at given depths: ``R^T (z K^-1 [u v 1]^T - t)``.

    Args:
        pixels: ``(u, v)`` [..., 2].
        depth: z in the camera [...], in the unit of the world.
        intrinsics: K, upper triangular (a skew is allowed) [..., 3, 3], in pixels.
        extrinsics: world to camera [..., 4, 4].

    Returns:
        Points [..., 3], float32 or wider.
    """
    pixels, depth, intrinsics, extrinsics = map(at_least_float32, (pixels, depth, intrinsics, extrinsics))
    if depth.device.type != "cpu":
        return _unproject_in_few_steps(pixels, depth, intrinsics, extrinsics)
    fx = intrinsics[..., 0, 0]
    fy = intrinsics[..., 1, 1]
    y = (pixels[..., 1] - intrinsics[..., 1, 2]) / fy
    x = (pixels[..., 0] - intrinsics[..., 0, 2] - intrinsics[..., 0, 1] * y) / fx
    shift = extrinsics[..., :3, 3]
    x = x * depth - shift[..., 0]
    y = y * depth - shift[..., 1]
    z = depth - shift[..., 2]
    # The product with R^T is written out: matmul would run in half precision under autocast, and
    # broadcasting would allocate nine numbers per pixel.
    rows = extrinsics[..., :3, :3].unbind(-2)
    return torch.stack(
        [x * rows[0][..., k] + y * rows[1][..., k] + z * rows[2][..., k] for k in range(3)], -1
    )


def _unproject_in_few_steps(pixels: Tensor, depth: Tensor, intrinsics: Tensor, extrinsics: Tensor) -> Tensor:
    """:func:`unproject` with fewer GPU launches but more temporaries; all inputs float32 or wider."""
    offset = pixels - intrinsics[..., :2, 2]
    y = offset[..., 1] / intrinsics[..., 1, 1]
    x = (offset[..., 0] - intrinsics[..., 0, 1] * y) / intrinsics[..., 0, 0]
    rays = F.pad(torch.stack((x, y), -1), (0, 1), value=1.0)
    inside = rays * depth[..., None] - extrinsics[..., :3, 3]
    return (inside[..., None] * extrinsics[..., :3, :3]).sum(-2)


def unproject_maps(
    depth: Float[Tensor, "*batch h w"], cameras: Cameras, pixels: Float[Tensor, "*batch h w 2"] | None = None
) -> Float[Tensor, "*batch h w 3"]:
    """World points of a depth map.

    Args:
        depth: z in the camera [..., h, w], in the unit of the world.
        cameras: with the leading dimensions of ``depth``.
        pixels: ``(u, v)`` of each depth [..., h, w, 2]; None: centres of all pixels.

    Returns:
        Points [..., h, w, 3], float32 or wider.
    """
    if pixels is None:
        centers = pixel_centers(cameras.height, cameras.width, at_least_float32(depth))
        pixels = centers.expand(*depth.shape, 2)
    intrinsics, extrinsics = (m[..., None, None, :, :] for m in (cameras.intrinsics, cameras.extrinsics))
    return unproject(pixels, depth, intrinsics, extrinsics)


def focal_lengths(cameras: Cameras) -> Float[Tensor, "*batch 2"]:
    """Focal lengths ``(fx, fy)`` in pixels."""
    return at_least_float32(cameras.intrinsics).diagonal(dim1=-2, dim2=-1)[..., :2]


def world_to_camera(
    points: Float[Tensor, "*batch 3"], extrinsics: Float[Tensor, "*#batch 4 4"]
) -> Float[Tensor, "*batch 3"]:
    """Transform world points to camera coordinates: ``R x + t``.

    Args:
        points: [..., 3] in the world.
        extrinsics: world to camera [..., 4, 4].

    Returns:
        Points [..., 3], float32 or wider; their third coordinate is the depth.
    """
    return _affine(extrinsics[..., :3, :], points.movedim(-1, 0)).movedim(0, -1).contiguous()


def _affine(matrices: Tensor, points: Tensor) -> Tensor:
    """``A x + b`` [r, ...] of points [c, ...] for matrices ``[A b]`` [..., r, c + 1], without matmul
    (see :func:`unproject`); column by column on a CPU, to save temporaries, else in one sum."""
    matrices = at_least_float32(matrices)
    points = at_least_float32(points)
    columns = matrices[(None,) * (points.dim() + 1 - matrices.dim())].movedim((-1, -2), (0, 1))
    last = len(points)
    if points.device.type != "cpu":
        return (columns[:last] * points[:, None]).sum(0) + columns[last]
    total = columns[0] * points[0]
    for number in range(1, last):
        total = total + columns[number] * points[number]
    return total + columns[last]


def project(
    points: Float[Tensor, "*batch 3"],
    intrinsics: Float[Tensor, "*#batch 3 3"],
    extrinsics: Float[Tensor, "*#batch 4 4"],
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    """Project world points to pixels and depths.

    Args:
        points: [..., 3] in the world.
        intrinsics: K, upper triangular [..., 3, 3], in pixels.
        extrinsics: world to camera [..., 4, 4].

    Returns:
        Pixels ``(u, v)`` [..., 2], meaningless where z <= 0, and depths z [...].
    """
    inside = _affine(extrinsics[..., :3, :], points.movedim(-1, 0))
    z = inside[2]
    seen = inside[:2] / torch.where(z > 0, z, torch.ones_like(z))
    return _affine(intrinsics[..., :2, :], seen).movedim(0, -1).contiguous(), z


def look_at_point(cameras: Cameras) -> Tensor:
    """:func:`meeting_point` [3] of the optical axes of V cameras."""
    return meeting_point(cameras.centers.double(), cameras.extrinsics[:, 2, :3].double())


def meeting_point(centers: Float[Tensor, "n 3"], directions: Float[Tensor, "n 3"]) -> Float[Tensor, "3"]:
    """Least-squares intersection [3] of lines; of parallel ones, the solution nearest to the mean of
    ``centers``.

    Args:
        centers: a point of each line, in float64.
        directions: unit vectors.
    """
    middle = centers.mean(0)
    identity = torch.eye(3, dtype=centers.dtype, device=centers.device)
    away = identity - directions[:, :, None] * directions[:, None]
    right = (away @ (centers - middle)[:, :, None]).sum(0)
    return middle + (torch.linalg.pinv(away.sum(0), rtol=1e-6) @ right)[:, 0]


def sample(
    maps: Float[Tensor, "m c H W"], image: Int[Tensor, "*n"], pixels: Float[Tensor, "*n 2"]
) -> Float[Tensor, "*n c"]:
    """Sample maps bilinearly, each pixel from a map of its own.

    Args:
        maps: m maps of one size [m, c, H, W], all finite: through rounding, a neighbouring map may
            contribute with a tiny weight.
        image: index of the map of each pixel [...].
        pixels: ``(u, v)`` [..., 2].

    Returns:
        Values [..., c]; 0 outside the map.
    """
    count, _, height, width = maps.shape
    u, v = pixels.unbind(-1)
    # One trilinear lookup: the maps are layers of a volume, and each pixel lies at the centre of its
    # layer. Pixels far outside are clamped, since large coordinates lose precision.
    layer = (2 * image.to(pixels) + 1) / count - 1
    grid = torch.stack(((2 / width * u - 1).clamp(-3, 3), (2 / height * v - 1).clamp(-3, 3), layer), -1)
    grid = grid.reshape(1, 1, 1, -1, 3)
    values = F.grid_sample(maps.transpose(0, 1)[None], grid, align_corners=False)
    return values[0, :, 0, 0].mT.reshape(*image.shape, maps.shape[1])
