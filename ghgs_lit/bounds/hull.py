"""Near and far of each pixel from the visual hull of the other views.

The rays of the subject's pixels are marched through the subject's box, and what the masks of the *other*
views allow is kept: the image-based visual hull (Matusik et al. 2000). Nothing here has a gradient.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Bool
from torch import Tensor

from ghgs_lit.bounds.box import SubjectBox
from ghgs_lit.bounds.rays import depths_in_box, projection_matrices, ray_directions
from ghgs_lit.bounds.silhouettes import Silhouettes, dilate, look_up, votes_outside
from ghgs_lit.types import Batch, Cameras, DepthBounds


@dataclass(frozen=True)
class VisualHull(SubjectBox):
    """``bounds(batch) -> DepthBounds``: where each ray of the subject enters and leaves the visual hull.

    Other pixels, and rays that miss the hull, keep their bounds in the box.

    Args:
        samples: depths that are tried along each ray; for the others see :class:`SubjectBox`.
    """

    samples: int = 48

    least: ClassVar[dict[str, int]] = {**SubjectBox.least, "samples": 2}

    def _within(self, batch: Batch, coarse: Silhouettes, lower: Tensor, upper: Tensor) -> DepthBounds:
        box = self._valid(depths_in_box(batch.cameras, lower, upper))
        start = box if coarse.stride == 1 else self._valid(depths_in_box(coarse.cameras, lower, upper))
        # One cell at least: the rays of a cell's pixels run beside the ray of its centre.
        hull = hull_bounds(
            coarse.masks, coarse.cameras, start, max(coarse.dilation, 1), self.tolerance, self.samples
        )
        near, far = (_enlarge(x, coarse.stride, batch.masks.shape[-2:]) for x in (hull.near, hull.far))
        return self._valid(DepthBounds(torch.maximum(box.near, near), torch.minimum(box.far, far)))


def hull_bounds(
    masks: Bool[Tensor, "B V h w"],
    cameras: Cameras,
    start: DepthBounds,
    radius: int,
    tolerance: int = 0,
    samples: int = 48,
) -> DepthBounds:
    """First and last depth within ``start`` that the dilated masks of the other views allow.

    Computed for the subject's pixels; others, and rays that miss the hull, keep their bounds.

    Args:
        masks: of the views.
        cameras: [B, V], of the masks' size.
        start: where the search begins and ends.
        radius: dilation of the masks in pixels.
        tolerance: how many other views may say "outside" of a depth that is allowed.
        samples: depths that are tried along each ray.
    """
    outside = votes_outside(dilate(masks, radius), masks)
    near, far = start.near.clone(), start.far.clone()
    steps = (torch.arange(samples, device=near.device, dtype=near.dtype) + 0.5) / samples
    directions, centers = ray_directions(cameras), cameras.centers
    projections = projection_matrices(cameras)
    for b in range(masks.shape[0]):
        for v in range(masks.shape[1]):
            rays = masks[b, v].nonzero(as_tuple=True)
            begin, length = near[b, v][rays], (far - near)[b, v][rays]
            depth = begin[:, None] + steps * length[:, None]
            votes = torch.zeros(depth.shape, dtype=torch.uint8, device=depth.device)
            for u in range(masks.shape[1]):
                if u != v:
                    along = (projections[b, u, :, :3] * directions[b, v][rays][:, None]).sum(-1)
                    origin = (projections[b, u, :, :3] * centers[b, v]).sum(-1) + projections[b, u, :, 3]
                    pixel = [torch.addcmul(origin[i], depth, along[:, i, None]) for i in range(3)]
                    votes += look_up(outside[b, u], *pixel)
            inside = (votes <= tolerance).to(torch.uint8)
            hit = inside.amax(1).bool()
            half = length / (2 * samples)
            first = depth.gather(1, inside.argmax(1, keepdim=True))[:, 0] - half
            last = depth.gather(1, samples - 1 - inside.flip(1).argmax(1, keepdim=True))[:, 0] + half
            near[b, v][rays] = torch.where(hit, first, begin)
            far[b, v][rays] = torch.where(hit, last, begin + length)
    return DepthBounds(near, far)


def _enlarge(values: Tensor, stride: int, size: tuple[int, int]) -> Tensor:
    """Values of cells for each of their pixels, cut to the image's ``size``."""
    values = values.repeat_interleave(stride, -2).repeat_interleave(stride, -1)
    return values[..., : size[0], : size[1]]
