"""Guides: full-resolution inputs of a dense head (images, masks and depths).

A patch is one token, so a head with tokens as its only input predicts soft edges. Published weights
use no guide."""

import functools

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.geometry.masks import coverage
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.method.plan.window import Window
from ghgs_lit.types import Batch

#: Channels of :func:`photo_guide` without further maps.
PHOTO_CHANNELS = 4


#: Maps whose channels form a guide; they are concatenated only within the window in use.
Guide = tuple[Float[Tensor, "n _ H W"], ...]


def photo_guide(batch: Batch, *maps: Float[Tensor, "B V _ H W"]) -> Guide:
    """Guide of images, mattes or masks, and further maps of all input views.

    Args:
        batch: images, masks and mattes are read.
        maps: further maps with any number of channels.
    """
    images = at_least_float32(batch.images)
    return tuple(part.flatten(0, 1) for part in (images, coverage(batch)[:, :, None], *maps))


class GuidePyramid(nn.Module):
    """Three convolutions of a guide, at full, half and quarter resolution, added to maps of a dense head.

    Args:
        channels: channels of the guide.
        features: channels at half and quarter resolution; the full one has half as many.
    """

    def __init__(self, channels: int, features: int):
        super().__init__()
        self.to_full = nn.Conv2d(channels, features // 2, 3, padding=1)
        self.to_half = nn.Conv2d(features // 2, features, 3, stride=2, padding=1)
        self.to_quarter = nn.Conv2d(features, features, 3, stride=2, padding=1)

    def forward(self, guide: Guide, targets: tuple[Window, Window, Window]) -> list[Float[Tensor, "n o h w"]]:
        """Maps at full, half and quarter resolution.

        Args:
            guide: maps of whole images.
            targets: windows of the head's maps, from fine to coarse, that the results are resized to.
        """
        whole = Window.whole(tuple(guide[0].shape[2:]))
        size = whole.full
        sizes = [whole.coarser(factor).full for factor in (1, 2, 4)]
        needed = [target.sources(n) for target, n in zip(targets, sizes, strict=True)]
        seen = functools.reduce(
            Window.hull,
            (window.grow(1).finer(factor, size) for window, factor in zip(needed, (1, 2, 4), strict=True)),
        )
        seen = seen.coarser(4).finer(4, size)
        parts = [part[..., *seen.slices].permute(0, 2, 3, 1) for part in guide]
        # Channels are innermost in memory.
        full = F.relu(self.to_full(torch.cat(parts, -1).permute(0, 3, 1, 2)))
        half = F.relu(self.to_half(full))
        maps = (full, half, F.relu(self.to_quarter(half)))
        return [
            seen.coarser(factor).resize(level, target)
            for level, factor, target in zip(maps, (1, 2, 4), targets, strict=True)
        ]
