"""How well the photographs agree about depths of each pixel.

A plane sweep (Collins, CVPR 1996) within each pixel's own bounds: a point on the surface has the same colour
in the views that see it.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.projection import at_least_float32, pixel_centers
from ghgs_lit.types import Batch, Cameras, DepthBounds

#: Mean absolute difference of two colours at which the consistency is 1 / e.
TOLERANCE = 0.1

#: Least cosine of the angle between the axes of two views that are compared (127 degrees): beyond it they
#: hardly see a common surface.
WIDEST = -0.6


@torch.no_grad()
def photo_consistency(batch: Batch, bounds: DepthBounds, steps: int) -> Float[Tensor, "B V S H W"]:
    """Agreement of each pixel of the subject with the best other view, in [0, 1], without a gradient.

    Args:
        batch: images, masks and cameras are read.
        bounds: near and far of each pixel, in metres.
        steps: S, how many depths are compared: the middles of S equal parts of near to far.

    Returns:
        0 outside the subject, and where no other view has the point inside its mask.
    """
    # All of it: half a pixel in bfloat16 is a different colour.
    with torch.autocast(batch.masks.device.type, enabled=False):
        return _sweep(batch, bounds, steps)


def _sweep(batch: Batch, bounds: DepthBounds, steps: int) -> Float[Tensor, "B V S H W"]:
    """:func:`photo_consistency` outside autocast."""
    b, v, height, width = batch.masks.shape
    near, far = at_least_float32(bounds.near), at_least_float32(bounds.far)
    shares = (torch.arange(steps, device=near.device, dtype=near.dtype) + 0.5) / steps
    colors = _smooth(batch.images.to(near), batch.masks)
    centers = pixel_centers(height, width, near)
    turn, shift, facing = (relation.to(near) for relation in _relations(batch.cameras))
    result = near.new_zeros(b, v, height, width, steps)
    for i in range(b):
        for j in range(v):
            mask = batch.masks[i, j]
            low, high = near[i, j][mask], far[i, j][mask]
            depth = low[:, None] + (high - low)[:, None] * shares
            pixels = F.pad(centers[mask], (0, 1), value=1.0)
            own = colors[i, j, :3][:, mask].T
            best = torch.zeros_like(depth)
            for k in range(v):
                if k == j or facing[i, j, k] < WIDEST:
                    continue
                rays = pixels @ turn[i, j, k].T
                best = torch.maximum(best, _match(colors[i, k], own, rays, shift[i, j, k], depth))
            result[i, j][mask] = best
    return result.permute(0, 1, 4, 2, 3)


def _match(other: Tensor, own: Tensor, rays: Tensor, shift: Tensor, depth: Tensor) -> Tensor:
    """Agreement [n, S] of colours ``own`` with the view ``other`` [4, H, W] along their rays in it."""
    points = rays[:, None] * depth[..., None] + shift
    z = points[..., 2:]
    front = z > 0
    size = points.new_tensor([other.shape[-1], other.shape[-2]])
    grid = points[..., :2] / torch.where(front, z, 1.0) * (2 / size) - 1
    seen = F.grid_sample(other[None], grid[None], align_corners=False)[0]
    difference = (seen[:3] - own.T[:, :, None]).abs().mean(0)
    return torch.exp(-difference / TOLERANCE) * seen[3] * front[..., 0]


def _smooth(images: Tensor, masks: Tensor) -> Tensor:
    """Colours averaged over the subject's pixels in 3 x 3, and the mask as a fourth channel."""
    inside = masks.to(images.dtype)[:, :, None]
    both = F.avg_pool2d(torch.cat((images * inside, inside), 2).flatten(0, 1), 3, 1, 1)
    both = both.unflatten(0, masks.shape[:2])
    colors = both[:, :, :3] / torch.where(both[:, :, 3:] > 0, both[:, :, 3:], 1.0)
    return torch.cat((colors, inside), 2)


def _relations(cameras: Cameras) -> tuple[Tensor, Tensor, Tensor]:
    """From pixels of view j to pixels of view k, ``z_k p_k = z_j turn p_j + shift``; cosine of their axes."""
    intrinsics, extrinsics = at_least_float32(cameras.intrinsics), at_least_float32(cameras.extrinsics)
    rotation, translation = extrinsics[..., :3, :3], extrinsics[..., :3, 3:]
    relative = rotation[:, None] @ rotation[:, :, None].mT
    turn = intrinsics[:, None] @ relative @ torch.linalg.inv(intrinsics)[:, :, None]
    shift = intrinsics[:, None] @ (translation[:, None] - relative @ translation[:, :, None])
    return turn, shift[..., 0], relative[..., 2, 2]
