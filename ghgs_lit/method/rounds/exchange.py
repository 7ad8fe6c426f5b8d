"""Feature exchange among the Gaussians of neighbouring pixels between rounds."""

import math
from functools import lru_cache
from typing import NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from ghgs_lit.extents import bucket_size
from ghgs_lit.method.heads.gaussian import RawGaussians
from ghgs_lit.ops.linear import Linear
from ghgs_lit.types import Batch

#: Side in pixels of the square window of neighbours whose features a Gaussian receives.
SIDE = 5


class Windows(NamedTuple):
    """Positions of Gaussians in maps cropped to the subject of each image.

    Attributes:
        place: flat index among the pixels of all maps.
        shape: number, height and width of the maps.
        spare: 1 if invalid rows use an extra index after all pixels, else 0.
    """

    place: Int[Tensor, " N"]
    shape: tuple[int, int, int]
    spare: int = 0

    @classmethod
    def of(cls, raw: RawGaussians, batch: Batch) -> "Windows":
        """Positions in maps of the size of the largest subject, each starting at its own subject.

        Args:
            raw: Gaussians of the batch with their pixels.
            batch: its extents are used, read from the device unless a plan has done so.
        """
        filled = [extent for extent in batch.extents if extent.count]
        height = max((extent.bottom - extent.top for extent in filled), default=1)
        width = max((extent.right - extent.left for extent in filled), default=1)
        if raw.real is not None:
            height = bucket_size(height)
            width = bucket_size(width)
        corners = [(extent.top, extent.left) if extent.count else (0, 0) for extent in batch.extents]
        top, left = _on_device(tuple(corners), raw.pixel.device)[raw.image].unbind(1)
        full = batch.masks.shape[-1]
        row = raw.pixel // full - top
        column = raw.pixel % full - left
        place = (raw.image * height + row) * width + column
        shape = (len(corners), height, width)
        if raw.real is None:
            return cls(place, shape)
        return cls(torch.where(raw.real, place, math.prod(shape)), shape, spare=1)


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # a later use may need gradients
def _on_device(numbers: tuple, device: torch.device) -> Tensor:
    """Cached device copy of host numbers, whose address captured graphs can rely on."""
    return torch.tensor(numbers).to(device, non_blocking=True)


class Exchange(nn.Module):
    """Adds features of neighbouring pixels' Gaussians to those of each Gaussian; initially adds 0.

    If several depths explain a colour, neighbours disambiguate, as in recurrent networks for optical
    flow (RAFT, Teed and Deng, ECCV 2020). Few channels and one convolution keep it cheap.

    Args:
        width: channels of the features.
        channels: channels of the exchanged features.
    """

    def __init__(self, width: int, channels: int):
        super().__init__()
        self.tell = Linear(width, channels)
        # Channels last is the layout of rows of Gaussians, and several times as fast on a CPU.
        self.across = nn.Conv2d(channels, channels, SIDE, padding=SIDE // 2).to(
            memory_format=torch.channels_last
        )
        self.hear = Linear(channels, width)
        nn.init.zeros_(self.hear.weight)
        nn.init.zeros_(self.hear.bias)

    def forward(self, known: Float[Tensor, "N w"], windows: Windows) -> Float[Tensor, "N w"]:
        """Add the neighbours' features.

        Args:
            known: features of each Gaussian.
            windows: positions of the Gaussians.
        """
        sent = self.tell(known)
        size = math.prod(windows.shape)
        maps = sent.new_zeros(size + windows.spare, sent.shape[1]).index_copy_(0, windows.place, sent)
        maps = self.across(maps[:size].view(*windows.shape, sent.shape[1]).permute(0, 3, 1, 2))
        place = windows.place.clamp(max=size - 1) if windows.spare else windows.place
        received = maps.permute(0, 2, 3, 1).flatten(0, 2).index_select(0, place)
        return known + self.hear(F.relu(received, inplace=True))
