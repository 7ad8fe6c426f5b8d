"""Sequences of different lengths packed into one tensor: views keep different numbers of patches. Only the
attention of a block mixes tokens, so views need no padding."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.types import true_places


class KeptPatches:
    """The kept patches of a batch, and their places among packed tokens. Packed tokens [T, C] are the
    sequences of all images, one after another: the special tokens of an image (class, camera or registers),
    then its kept patches, row by row. ``kept``: on any device. ``device``: that of the tokens."""

    def __init__(self, kept: Bool[Tensor, "b v h w"], device: torch.device):
        _, _, height, width = self.grid = tuple(kept.shape)
        self._kept = kept.cpu()  # lengths and box are needed as Python numbers
        self._counts = self._kept.flatten(2).sum(-1)
        total = int(self._counts.sum())
        is_whole = total == kept.numel()
        self.index = torch.arange(total, device=device) if is_whole else true_places(kept.to(device), total)
        self.image = self.index // (height * width)
        self.row = self.index // width % height
        self.column = self.index % width

    def lengths(self, special: int) -> list[int]:
        """Number of tokens of each image, with ``special`` special ones."""
        return (self._counts + special).flatten().tolist()

    def element_lengths(self, special: int) -> list[int]:
        """Number of tokens of each batch element, with ``special`` special ones in each view."""
        return (self._counts + special).sum(1).tolist()

    def box(self, margin: int) -> tuple[slice, slice]:
        """Rows and columns of the patches that are kept in any image, with a margin; at least one patch."""
        anywhere = self._kept.flatten(0, 1).any(0)
        return _around(anywhere.any(1), margin), _around(anywhere.any(0), margin)

    def select(self, patches: Float[Tensor, "n p c"]) -> Float[Tensor, "N c"]:
        """The kept ones of the tokens of all patches."""
        flat = patches.flatten(0, 1)
        return flat if len(flat) == len(self.index) else flat[self.index]

    def join(self, special: Tensor, patches: Tensor) -> Tensor:
        """Packed tokens [B * V * s + N, C] of special [B * V, s, C] and patch tokens, in the wider dtype."""
        images, count, width = special.shape
        number = torch.arange(images, device=patches.device)
        before = number * count + torch.searchsorted(self.image, number)
        places = before[:, None] + torch.arange(count, device=patches.device)
        dtype = torch.promote_types(special.dtype, patches.dtype)
        packed = patches.new_empty(images * count + len(patches), width, dtype=dtype)
        packed.index_copy_(0, places.flatten(), special.flatten(0, 1).to(dtype))
        return packed.index_copy_(0, self._places(count), patches.to(dtype))

    def take(self, packed: Float[Tensor, "t c"], special: int) -> Float[Tensor, "N c"]:
        """The patch tokens of packed tokens with ``special`` special ones in each image."""
        return packed[self._places(special)]

    def positions(self, special: int) -> Int[Tensor, "t 2"]:
        """``(row, column)`` of packed tokens in the image: (0, 0) for special ones, from (1, 1) for
        patches."""
        at_patches = torch.stack((self.row, self.column), dim=-1) + 1
        b, v = self.grid[:2]
        return self.join(at_patches.new_zeros(b * v, special, 2), at_patches)

    def _places(self, special: int) -> Int[Tensor, " N"]:
        return torch.arange(len(self.index), device=self.index.device) + (self.image + 1) * special


def _around(line: Bool[Tensor, " n"], margin: int) -> slice:
    """From the first to the last True with a margin inside the line; the first place if there is none."""
    places = line.nonzero()[:, 0].tolist() or [0]
    return slice(max(places[0] - margin, 0), min(places[-1] + 1 + margin, len(line)))
