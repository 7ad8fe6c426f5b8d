"""Kept patches: sequences of different lengths packed into one tensor.

Views keep different numbers of patches. Only attention mixes tokens, so views need no padding on a
CPU. On a GPU, where shapes must repeat, each view's rows are padded to a shape bucket, and the padding
is masked in attention."""

from collections.abc import Sequence
from functools import cached_property

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.extents import Extent, extents, true_places
from ghgs_lit.method.plan.rows import Rows


class KeptPatches:
    """The kept patches of a batch, and their positions among packed tokens.

    Packed tokens [T, C] are the concatenated sequences of all images: the special tokens of an image
    (class, camera or registers), then its kept patches, row by row. Positions are computed on first
    use.

    Args:
        kept: mask of kept patches, on any device.
        device: device of the tokens.
        known: extent of the kept patches of each image; None: computed from ``kept``.
        size: number of rows per image, at least that of its kept patches: the rest repeats the last one
            (the first patch if none is kept); None: no padding."""

    def __init__(
        self,
        kept: Bool[Tensor, "b v h w"],
        device: torch.device,
        known: Sequence[Extent] | None = None,
        size: int | None = None,
    ):
        elements, views, height, width = self.grid = tuple(kept.shape)
        if size is not None:
            known = [Extent(size, 0, height, 0, width)] * (elements * views)
        self._extents = extents(kept.flatten(0, 1)) if known is None else known
        counts = [extent.count for extent in self._extents]
        self._counts = [counts[first : first + views] for first in range(0, len(counts), views)]
        self._kept = kept
        self.device = device
        self.size = size
        self.is_whole = size is None and sum(counts) == kept.numel()
        self._packed: dict[int, Int[Tensor, " N"]] = {}

    @classmethod
    def whole(cls, grid: Sequence[int], device: torch.device) -> "KeptPatches":
        """All patches of a grid [b, v, h, w] of elements, views, rows and columns."""
        images, (height, width) = grid[0] * grid[1], grid[2:]
        kept = torch.ones(*grid, dtype=torch.bool, device=device)
        return cls(kept, device, [Extent(height * width, 0, height, 0, width)] * images)

    @cached_property
    def _rows(self) -> Rows:
        """Rows padded to the same number for each image."""
        return Rows.filled(self.mask.flatten(0, 1).flatten(1), self.size, 1)

    @property
    def real(self) -> Bool[Tensor, " N"] | None:
        """Rows that are kept patches rather than padding; None: all."""
        return None if self.size is None else self._rows.real

    @cached_property
    def index(self) -> Int[Tensor, " N"]:
        """Index of each row's patch among all patches."""
        if self.is_whole:
            return torch.arange(self._kept.numel(), device=self.device)
        if self.size is None:
            return true_places(self.mask, sum(extent.count for extent in self._extents))
        return self._rows.index

    @cached_property
    def image(self) -> Int[Tensor, " N"]:
        """Image ``b * V + v`` of each row."""
        return self.index // (self.grid[2] * self.grid[3])

    @cached_property
    def row(self) -> Int[Tensor, " N"]:
        """Grid row of each row's patch."""
        return self.index // self.grid[3] % self.grid[2]

    @cached_property
    def column(self) -> Int[Tensor, " N"]:
        """Grid column of each row's patch."""
        return self.index % self.grid[3]

    @cached_property
    def number(self) -> Int[Tensor, " p"]:
        """For each of all patches, its row if it is kept; otherwise a meaningless valid index."""
        if self.size is not None:
            return self._rows.places(self.mask.numel())[1]
        return self.index if self.is_whole else (self.mask.flatten().cumsum(0) - 1).clamp(min=0)

    @cached_property
    def mask(self) -> Bool[Tensor, "b v h w"]:
        """Mask of the kept patches, on the tokens' device."""
        if self.is_whole:
            return torch.ones(self.grid, dtype=torch.bool, device=self.device)
        return self._kept.to(self.device)

    @property
    def is_even(self) -> bool:
        """Whether all images are known to have the same number of rows, without reading masks."""
        return self.is_whole or self.size is not None

    def real_tokens(self, special: int) -> Bool[Tensor, " t"] | None:
        """Packed tokens that are special tokens or kept patches rather than padding; None: all.

        Args:
            special: number of special tokens in each image.
        """
        if self.real is None:
            return None
        return F.pad(self.real.unflatten(0, (-1, self.size)), (special, 0), value=True).flatten()

    def lengths(self, special: int) -> list[int]:
        """Number of tokens of each image, including ``special`` special ones."""
        return [extent.count + special for extent in self._extents]

    def element_lengths(self, special: int) -> list[int]:
        """Number of tokens of each batch element, including ``special`` special ones in each view."""
        return [sum(element) + len(element) * special for element in self._counts]

    def box(self, margin: int) -> tuple[slice, slice]:
        """Rows and columns of the bounding box of patches kept in any image, at least one patch.

        Args:
            margin: number of patches added on each side, clipped to the grid.
        """
        filled = [extent for extent in self._extents if extent.count] or [Extent(1, 0, 1, 0, 1)]
        rows = min(e.top for e in filled), max(e.bottom for e in filled)
        columns = min(e.left for e in filled), max(e.right for e in filled)
        sides = zip((rows, columns), self.grid[2:], strict=True)
        return tuple(slice(max(a - margin, 0), min(b + margin, side)) for (a, b), side in sides)

    def select(self, patches: Float[Tensor, "n p c"]) -> Float[Tensor, "N c"]:
        """Select the kept patches from the tokens of all patches."""
        flat = patches.flatten(0, 1)
        return flat if self.is_whole else flat[self.index]

    def join(self, special: Tensor, patches: Tensor) -> Tensor:
        """Pack special tokens and patch tokens.

        Args:
            special: special tokens of each image [B * V, s, C].
            patches: tokens of the kept patches [N, C].

        Returns:
            Packed tokens [B * V * s + N, C] in the wider dtype.
        """
        images, count, width = special.shape
        dtype = torch.promote_types(special.dtype, patches.dtype)
        if self.is_even:
            parts = (special.to(dtype), patches.to(dtype).reshape(images, -1, width))
            return torch.cat(parts, dim=1).flatten(0, 1)
        number = torch.arange(images, device=patches.device)
        before = number * count + torch.searchsorted(self.image, number)
        places = before[:, None] + torch.arange(count, device=patches.device)
        packed = patches.new_empty(images * count + len(patches), width, dtype=dtype)
        packed.index_copy_(0, places.flatten(), special.flatten(0, 1).to(dtype))
        return packed.index_copy_(0, self._places(count), patches.to(dtype))

    def take(self, packed: Float[Tensor, "t c"], special: int) -> Float[Tensor, "N c"]:
        """Extract the patch tokens of packed tokens with ``special`` special ones per image."""
        if self.is_even:
            images = self.grid[0] * self.grid[1]
            return packed.unflatten(0, (images, -1))[:, special:].flatten(0, 1)
        return packed[self._places(special)]

    def positions(self, special: int) -> Int[Tensor, "t 2"]:
        """``(row, column)`` of packed tokens in the image: (0, 0) for special ones, patches start at
        (1, 1).

        Args:
            special: number of special tokens in each image.
        """
        at_patches = torch.stack((self.row, self.column), dim=-1) + 1
        b, v = self.grid[:2]
        return self.join(at_patches.new_zeros(b * v, special, 2), at_patches)

    def _places(self, special: int) -> Int[Tensor, " N"]:
        """Cached indices of the patch tokens among packed tokens."""
        if special not in self._packed:
            numbers = torch.arange(len(self.index), device=self.index.device)
            self._packed[special] = numbers + (self.image + 1) * special
        return self._packed[special]
