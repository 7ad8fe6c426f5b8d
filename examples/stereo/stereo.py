"""A custom depth head: recurrent stereo between neighbouring views, for comparison with the paper's.

    export GHGS_PLUGINS=examples/stereo/stereo.py
    ghgs train --config-dir examples/stereo/conf model=gps

It follows the published description of GPS-Gaussian (Zheng et al., CVPR 2024): one small network
computes features of all views; they are correlated along epipolar lines; a GRU updates the estimate a
few times from the correlations around it (RAFT-Stereo, Lipson et al., 3DV 2021); upsampling is convex
(RAFT, Teed and Deng, ECCV 2020). In contrast to it, images are not rectified: equal steps of inverse
depth are the equal steps of disparity of a rectified pair. The two pairs of a view give one depth,
and only the last update contributes to the loss.
"""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor, nn

from ghgs_lit.config import register
from ghgs_lit.config.options import Options
from ghgs_lit.extents import bucket_size, true_places
from ghgs_lit.geometry.masks import coverage, surface_colors
from ghgs_lit.geometry.precision import exact, without_float16
from ghgs_lit.geometry.projection import at_least_float32, pixel_centers, project, sample, unproject
from ghgs_lit.method.heads.depth import BOUNDED, finite_maps
from ghgs_lit.method.heads.dpt import ResidualUnit
from ghgs_lit.method.plan import Plan
from ghgs_lit.ops.activation import bounded_sigmoid
from ghgs_lit.types import Batch, Cameras, DepthBounds, DepthMaps, Tokens

#: Side of a cell in pixels, and channels of its features and of the GRU's memory.
CELL = 4
CHANNELS = 32
#: Number of neighbouring views that each view is paired with.
PAIRS = 2
#: Resolutions of the correlations along depth, each half of the previous one; steps to either side.
LEVELS = 3
RADIUS = 4

_inverse = BOUNDED["bounded_inverse"]


@register("depth_head", "stereo")
class StereoHeadOptions(Options):
    """Images to one depth for each pixel, by stereo between neighbouring views."""

    group = "depth_head"
    consistency_depths: int = Field(48, gt=0, le=4096, multiple_of=2 ** (LEVELS - 1))
    """Number of inverse depths from near to far at which neighbouring views are correlated"""
    updates: int = Field(3, ge=1, le=64)
    """Number of GRU updates of the inverse depth; 3 as published, and no stereo method uses more than 64"""

    def build(self, dim_latent: int) -> "StereoHead":
        """Build the stage, which uses no tokens."""
        return StereoHead(self)


class StereoHead(nn.Module):
    """Depths from correlations of neighbouring views."""

    is_bounded = True

    def __init__(self, options: StereoHeadOptions):
        super().__init__()
        self.options = options
        self.features = nn.Sequential(
            nn.Conv2d(4, CHANNELS // 2, 4, stride=2, padding=1),
            ResidualUnit(CHANNELS // 2, rectified_skip=False),
            nn.Conv2d(CHANNELS // 2, CHANNELS, 4, stride=2, padding=1),
            ResidualUnit(CHANNELS, rectified_skip=False),
            ResidualUnit(CHANNELS, rectified_skip=False),
            nn.Conv2d(CHANNELS, 3 * CHANNELS, 1),
        )
        self.update = Update(CHANNELS)
        self.weights = _two_layers(CHANNELS, 9 * CELL**2)

    def forward(
        self, tokens: Tokens, batch: Batch, bounds: DepthBounds, plan: Plan | None = None
    ) -> DepthMaps:
        """Depths of all pixels between the nearest and the farthest bound of their view.

        Args:
            tokens: not used.
            batch: images, masks and cameras are read.
            bounds: in metres.
            plan: not used.

        Returns:
            Depths in metres, valid inside the subject, with confidences of 1.
        """
        height, width = batch.masks.shape[2:]
        near, far = subject_range(bounds, batch)
        with without_float16(batch.masks.device.type):
            fraction = self._fraction(batch, near, far)[..., :height, :width]
        depth = _inverse(fraction.view(batch.masks.shape), near, far)
        return finite_maps(depth, batch, torch.ones_like(depth), bounds)

    def _fraction(self, batch: Batch, near: Tensor, far: Tensor) -> Float[Tensor, "n h w"]:
        """Position of each pixel's depth between near (0) and far (1), padded to whole cells."""
        images = torch.cat((surface_colors(batch), coverage(batch)[:, :, None]), 2)
        images = F.pad(images, (0, -images.shape[-1] % CELL, 0, -images.shape[-2] % CELL))
        maps = self.features(images.flatten(0, 1).nan_to_num().to(self.features[0].weight.dtype))
        features, memory, context = maps.chunk(3, 1)
        features = at_least_float32(features).unflatten(0, batch.masks.shape[:2])
        cameras = batch.cameras.crop(0, 0, *images.shape[-2:]).resize(*features.shape[-2:])
        inside = F.max_pool2d(images[:, :, 3], CELL) > 0
        cells = true_places(inside, _most_cells(batch, inside.numel()), repeats=True)
        matches = correlations(features, cameras, cells, near, far, self.options.consistency_depths)
        volume = matches.new_zeros(inside.numel(), matches.shape[1]).index_copy(0, cells, matches)
        volume = volume.view(-1, *inside.shape[2:], matches.shape[1]).movedim(-1, 1)
        levels = [volume] + [F.avg_pool3d(volume[:, None], (2**i, 1, 1))[:, 0] for i in range(1, LEVELS)]
        memory = memory.tanh()
        context = context.relu()
        raw = volume.new_zeros(len(volume), 1, *inside.shape[2:])
        for _ in range(self.options.updates):
            memory, change = self.update(memory, context, levels, bounded_sigmoid(raw))
            raw = raw + change
        return upsample(bounded_sigmoid(raw), at_least_float32(self.weights(memory)))


def _most_cells(batch: Batch, count: int) -> int:
    """Upper bound of the number of cells with a pixel of a subject, without a synchronisation.

    Args:
        batch: with cached extents of its masks; mattes may extend beyond them.
        count: number of all cells.
    """
    if batch.alpha is not None:
        return count
    return min(bucket_size(sum(extent.cells(CELL) for extent in batch.extents)), count)


def _two_layers(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, inputs, 3, padding=1), nn.ReLU(), nn.Conv2d(inputs, outputs, 1))


class Update(nn.Module):
    """One update: correlations around the estimate, a convolutional GRU, a change of the estimate."""

    def __init__(self, channels: int):
        super().__init__()
        self.seen = nn.Conv2d(LEVELS * (2 * RADIUS + 1) + 1, channels, 3, padding=1)
        self.gates = nn.Conv2d(3 * channels, 2 * channels, 3, padding=1)
        self.candidate = nn.Conv2d(3 * channels, channels, 3, padding=1)
        self.change = _two_layers(channels, 1)
        nn.init.zeros_(self.change[-1].weight)
        nn.init.zeros_(self.change[-1].bias)

    def forward(
        self,
        memory: Float[Tensor, "n c h w"],
        context: Float[Tensor, "n c h w"],
        levels: list[Float[Tensor, "n _ h w"]],
        fraction: Float[Tensor, "n 1 h w"],
    ) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "n 1 h w"]]:
        """The next memory, and the change of the raw estimate.

        Args:
            memory: of the GRU, in [-1, 1].
            context: features of the view.
            levels: correlations from near to far, from fine to coarse.
            fraction: the estimate, 0 at near and 1 at far.
        """
        seen = torch.cat([*(look_up(level, fraction) for level in levels), 2 * fraction - 1], 1)
        x = torch.cat((self.seen(seen.to(memory.dtype)).relu(), context), 1)
        forget, reset = self.gates(torch.cat((memory, x), 1)).sigmoid().chunk(2, 1)
        candidate = self.candidate(torch.cat((reset * memory, x), 1)).tanh()
        memory = torch.lerp(memory, candidate.to(memory.dtype), forget.to(memory.dtype))
        hidden = self.change[:-1](memory)
        last = self.change[-1]
        # In float32 also under autocast: a step of inverse depth is centimetres.
        with exact(hidden.device.type):
            return memory, at_least_float32(last(hidden.to(last.weight.dtype)))


def subject_range(
    bounds: DepthBounds, batch: Batch
) -> tuple[Float[Tensor, "B V 1 1"], Float[Tensor, "B V 1 1"]]:
    """The nearest and the farthest bound of the subject's pixels in each view; of all pixels if it has none.

    Args:
        bounds: of all pixels, in metres.
        batch: masks are read.

    Returns:
        Near and far in metres.
    """
    masks = batch.masks
    used = masks | ~masks.any(-1, keepdim=True).any(-2, keepdim=True)
    near = torch.where(used, at_least_float32(bounds.near), torch.inf).amin((-2, -1), keepdim=True)
    far = torch.where(used, at_least_float32(bounds.far), -torch.inf).amax((-2, -1), keepdim=True)
    return near, far


def neighboring_views(cameras: Cameras) -> Int[Tensor, "n p"]:
    """For each image ``b * V + v``, the images with the smallest angles between optical axes.

    Args:
        cameras: [B, V].

    Returns:
        Indices ``b * V + v`` of :data:`PAIRS` images, or of all others if there are fewer.
    """
    count, views = cameras.shape
    forward = at_least_float32(cameras.extrinsics)[..., 2, :3]
    facing = (forward[:, :, None] * forward[:, None]).sum(-1)
    itself = torch.eye(views, dtype=torch.bool, device=facing.device)
    nearest = facing.masked_fill(itself, -torch.inf).topk(min(PAIRS, views - 1)).indices
    return (nearest + views * torch.arange(count, device=nearest.device)[:, None, None]).flatten(0, 1)


def correlations(
    features: Float[Tensor, "B V c h w"],
    cameras: Cameras,
    cells: Int[Tensor, " N"],
    near: Float[Tensor, "B V 1 1"],
    far: Float[Tensor, "B V 1 1"],
    steps: int,
) -> Float[Tensor, "N S"]:
    """Products of features of cells and of neighbouring views at S depths, divided by ``sqrt(c)``.

    The larger one of the two neighbours counts, because a surface is often occluded in one; 0 if the
    point is behind both or outside their images.

    Args:
        features: of cells, float32 or wider.
        cameras: [B, V], of images whose pixels are the cells.
        cells: flat indices among the cells of all images.
        near: in metres.
        far: in metres.
        steps: S; depths have equal steps of inverse depth from near to far.
    """
    height, width = features.shape[-2:]
    flat = features.flatten(0, 1)
    image = cells // (height * width)
    place = cells % (height * width)
    with torch.no_grad(), exact(features.device.type):
        share = torch.linspace(0, 1, steps, device=features.device, dtype=features.dtype)
        depth = _inverse(share, *(bound.flatten()[image, None].to(features) for bound in (near, far)))
        matrices = [m.to(features).flatten(0, 1) for m in (cameras.intrinsics, cameras.extrinsics)]
        centers = pixel_centers(height, width, features).flatten(0, 1)[place, None]
        points = unproject(centers.expand(*depth.shape, 2), depth, *(m[image, None] for m in matrices))
        other = neighboring_views(cameras)[image]
        points = points[:, None].expand(-1, other.shape[1], -1, -1)
        pixels, z = project(points, *(m[other][:, :, None] for m in matrices))
    there = sample(flat, other[..., None].expand(z.shape), pixels)
    products = (there * flat.flatten(2)[image, :, place][:, None, None]).sum(-1) / flat.shape[1] ** 0.5
    return torch.where(z > 0, products, 0).amax(1)


def look_up(level: Float[Tensor, "n s h w"], fraction: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n r h w"]:
    """Values at the estimate and at :data:`RADIUS` steps to either side, interpolated linearly.

    Args:
        level: values at equal steps from near to far; constant beyond.
        fraction: the estimate, 0 at near and 1 at far.

    Returns:
        ``2 * RADIUS + 1`` values of each cell.
    """
    last = level.shape[1] - 1
    around = torch.arange(-RADIUS, RADIUS + 1, device=level.device).view(-1, 1, 1)
    at = (fraction * last + around).clamp(0, last)
    low = at.detach().long().clamp(max=last - 1)
    return torch.lerp(level.gather(1, low), level.gather(1, low + 1), at - low)


def upsample(maps: Float[Tensor, "n 1 h w"], weights: Float[Tensor, "n _ h w"]) -> Float[Tensor, "n h2 w2"]:
    """Upsample maps to :data:`CELL` times their resolution.

    Each pixel is a convex combination of the 3 x 3 cells around its cell, with replicated borders
    (RAFT, Teed and Deng, ECCV 2020).

    Args:
        maps: of cells.
        weights: ``9 * CELL**2`` channels, logits of the shares of the cells.
    """
    n, _, height, width = maps.shape
    shares = weights.view(n, 9, CELL, CELL, height, width).softmax(1)
    around = F.unfold(F.pad(maps, (1, 1, 1, 1), mode="replicate"), 3).view(n, 9, 1, 1, height, width)
    return (shares * around).sum(1).permute(0, 3, 1, 4, 2).reshape(n, CELL * height, CELL * width)
