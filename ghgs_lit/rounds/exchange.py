"""Exchange of features among Gaussians of neighbouring pixels, once a round."""

from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from ghgs_lit.heads.gaussian import RawGaussians
from ghgs_lit.types import Batch

#: Pixels: side of the square around a Gaussian's pixel from which it hears.
REACH = 5


class Windows(NamedTuple):
    """Positions of Gaussians in maps cropped to the subject of each image.

    ``place`` counts through the pixels of all maps, whose number, height and width are ``shape``.
    """

    place: Int[Tensor, " N"]
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, raw: RawGaussians, batch: Batch) -> "Windows":
        """Maps of the size of the largest subject; each begins at its subject's first row and column."""
        filled = [extent for extent in batch.extents if extent.count]
        height = max((extent.bottom - extent.top for extent in filled), default=1)
        width = max((extent.right - extent.left for extent in filled), default=1)
        corners = [(extent.top, extent.left) if extent.count else (0, 0) for extent in batch.extents]
        corners = torch.tensor(corners).to(raw.pixel.device, non_blocking=True)
        top, left = corners[raw.image].unbind(1)
        full = batch.masks.shape[-1]
        row, column = raw.pixel // full - top, raw.pixel % full - left
        return cls((raw.image * height + row) * width + column, (len(corners), height, width))


class Exchange(nn.Module):
    """Adds to what each Gaussian knows what those of the pixels around it tell; untrained, nothing.

    Where several depths explain a colour, neighbours decide, as in recurrent networks of optical flow (RAFT,
    Teed and Deng, ECCV 2020). Few channels and one convolution keep it cheap. ``width``: of what a Gaussian
    knows. ``channels``: of what it tells.
    """

    def __init__(self, width: int, channels: int):
        super().__init__()
        self.tell = nn.Linear(width, channels)
        # Channels last is several times as fast on a CPU, and the order that rows of Gaussians have already.
        self.across = nn.Conv2d(channels, channels, REACH, padding=REACH // 2).to(
            memory_format=torch.channels_last
        )
        self.hear = nn.Linear(channels, width)
        nn.init.zeros_(self.hear.weight)
        nn.init.zeros_(self.hear.bias)

    def forward(self, known: Float[Tensor, "N w"], windows: Windows) -> Float[Tensor, "N w"]:
        """``known`` with what the neighbours add."""
        return known + self.hear(F.relu(self.heard(known, windows)))

    def heard(self, known: Float[Tensor, "N w"], windows: Windows) -> Float[Tensor, "N c"]:
        """What the neighbours tell; pixels without a Gaussian tell zeros."""
        told, (count, height, width) = self.tell(known), windows.shape
        maps = told.new_zeros(count * height * width, told.shape[1]).index_copy(0, windows.place, told)
        maps = self.across(maps.view(count, height, width, told.shape[1]).permute(0, 3, 1, 2))
        return maps.permute(0, 2, 3, 1).flatten(0, 2).index_select(0, windows.place)
