"""Rows: pixels or tokens of a batch that a stage computes, as an index tensor of known size."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.extents import true_places


def rounds_up(device: torch.device) -> bool:
    """Whether numbers of rows are rounded up to shape buckets: on a GPU, so that shapes repeat; on a CPU
    only valid rows are computed."""
    return device.type != "cpu"


@dataclass(frozen=True)
class Rows:
    """Rows of each group (an image, or an element of the batch), concatenated.

    Exact rows (``real`` is None) are all valid. Padded ones have the same number in each group: valid
    rows first, then repetitions of the last valid row, or of the group's first pixel or token if none
    is valid.

    Attributes:
        index: indices of the rows among all pixels or tokens, ascending within a group.
        counts: number of rows of each group.
        images: number of images of a group.
        real: which rows are valid; None: all."""

    index: Int[Tensor, " n"]
    counts: tuple[int, ...]
    images: int = 1
    real: Bool[Tensor, " n"] | None = None

    @classmethod
    def exact(cls, wanted: Bool[Tensor, "..."], counts: Sequence[int], images: int) -> "Rows":
        """Rows of the selected pixels or tokens.

        Args:
            wanted: mask of pixels or tokens, group by group.
            counts: number of selected ones in each group.
            images: number of images of a group.
        """
        return cls(true_places(wanted, sum(counts)), tuple(counts), images)

    @classmethod
    def filled(cls, wanted: Bool[Tensor, "g m"], size: int, images: int) -> "Rows":
        """Rows of the selected pixels or tokens, padded to ``size`` in each group.

        Args:
            wanted: mask of m pixels or tokens of each of g groups.
            size: number of rows of each group, at least that of the selected ones.
            images: number of images of a group.
        """
        groups, of_group = wanted.shape
        number = torch.arange(of_group, device=wanted.device)
        # One long cumulative sum: per-row sums would use only one block of GPU threads each.
        ranks = wanted.flatten().cumsum(0).view_as(wanted)
        if groups > 1:
            ranks = ranks - (ranks[:, :1] - wanted[:, :1].long())
        # The n-th valid row goes to index n, counted from 1; all others write 0 to index 0.
        places = number.new_zeros(groups, size + 1).scatter_(1, ranks * wanted, number * wanted)
        total = ranks[:, -1:]
        order = torch.arange(1, size + 1, device=wanted.device)
        index = places.gather(1, torch.minimum(order, total))
        if groups > 1:
            index = index + torch.arange(0, wanted.numel(), of_group, device=wanted.device)[:, None]
        return cls(index.flatten(), (size,) * groups, images, (order <= total).flatten())

    def only(self, valid: Bool[Tensor, "..."]) -> "Rows":
        """Keep only valid rows; in padded rows, the others are marked as not real.

        Args:
            valid: mask of all pixels or tokens, in any shape.
        """
        stays = valid.flatten()[self.index]
        if self.real is not None:
            return dataclasses.replace(self, real=self.real & stays)
        if bool(stays.all()):
            return self
        counts = tuple(int(part.sum()) for part in stays.split(self.counts))
        return dataclasses.replace(self, index=self.index[stays], counts=counts)

    @property
    def tables(self) -> list[tuple[Int[Tensor, "*g n"], Bool[Tensor, "*g n"] | None]]:
        """Tables of indices and of their validity: one per group, or a single one if rows are padded."""
        if self.real is None:
            return [(part, None) for part in self.index.split(self.counts)]
        shape = (len(self.counts), self.counts[0])
        return [(self.index.view(shape), self.real.view(shape))]

    def take(self, values: Float[Tensor, "t _"]) -> Float[Tensor, "n _"]:
        """Select the values of the rows from those of all pixels or tokens."""
        is_whole = self.real is None and len(self.index) == len(values)
        return values if is_whole else values[self.index]

    def put(
        self, values: Sequence[Float[Tensor, "t _"]], new: Sequence[Float[Tensor, "n _"]]
    ) -> tuple[Float[Tensor, "t _"], ...]:
        """Replace the values of valid rows in tensors of all pixels or tokens, out of place.

        Args:
            values: values of all pixels or tokens.
            new: values of the rows.
        """
        if self.real is not None:
            belongs, number = self.places(len(values[0]))
            pairs = zip(values, new, strict=True)
            return tuple(torch.where(belongs[:, None], y.index_select(0, number), x) for x, y in pairs)
        if len(self.index) == len(values[0]):
            return tuple(new)
        return tuple(x.index_copy(0, self.index, y) for x, y in zip(values, new, strict=True))

    def places(self, total: int) -> tuple[Bool[Tensor, " t"], Int[Tensor, " t"]]:
        """Invert the index: which of ``total`` pixels or tokens have a valid row, and the number of that
        row (0 for others)."""
        numbers = torch.arange(len(self.index), device=self.index.device)
        # Invalid rows are scattered to an extra entry, which is cut off.
        target = self.index if self.real is None else torch.where(self.real, self.index, total)
        row_of = numbers.new_full((total + 1,), -1).scatter_(0, target, numbers)[:total]
        return row_of >= 0, row_of.clamp(min=0)

    def within(self, images: slice) -> slice:
        """Rows of consecutive images ``b * V + v``, which must be whole groups."""
        first = images.start // self.images
        last = images.stop // self.images
        return slice(sum(self.counts[:first]), sum(self.counts[:last]))

    def splits(self, images: int) -> tuple[int, ...]:
        """Number of rows of each element of ``images`` images, which must be whole groups."""
        step = images // self.images
        return tuple(sum(self.counts[first : first + step]) for first in range(0, len(self.counts), step))
