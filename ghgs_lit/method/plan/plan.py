"""The plan of a batch, and the only place where a prediction copies mask statistics to the host."""

import dataclasses
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ghgs_lit.extents import Extent, bucket_size, extent_numbers, true_places
from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.method.plan.patches import KeptPatches
from ghgs_lit.method.plan.rows import Rows, rounds_up
from ghgs_lit.method.plan.window import Span, Window, subject_windows
from ghgs_lit.types import DecodedPixels, Prediction

#: Safety factor of sizes after earlier ones were too small.
_SPARE = 1.15


@dataclass(frozen=True)
class Sizes:
    """A shape bucket: sizes shared by all its scenes.

    Attributes:
        pixels: rows of the subject's pixels per element.
        peers: rows of recalibrated tokens per element.
        kept: rows of kept patches per image; 0: all patches.
        shown: rows of foreground patches per image.
        window: window of patches that contains every subject.
    """

    pixels: int
    peers: int
    kept: int
    shown: int
    window: Window


@dataclass(frozen=True)
class Plan:
    """Patches, tokens and pixels that the stages compute.

    Attributes:
        masks: the subject's pixels.
        shown: foreground patches, those with a pixel of the subject.
        kept: patches that become tokens.
        extents: extent of the subject in each image ``b * V + v``.
        shown_extents: extent of the patches ``shown`` in each image, in patches.
        patch_size: side of a patch in pixels.
        pixels: pixels that dense heads decode; ``all``: whole views.
        tokens: tokens that are recalibrated; ``all``: including the background's, which need depths, too.
        flags: values of further tensors that were read with the masks.
        sizes: the shape bucket; None: exact sizes of the scene."""

    masks: Bool[Tensor, "B V H W"]
    shown: Bool[Tensor, "B V h w"]
    kept: KeptPatches
    extents: tuple[Extent, ...]
    shown_extents: tuple[Extent, ...]
    patch_size: int
    pixels: DecodedPixels = "subject"
    tokens: DecodedPixels = "subject"
    flags: tuple[bool, ...] = ()
    sizes: Sizes | None = None

    @cached_property
    def shown_patches(self) -> KeptPatches:
        """The patches ``shown``, all of which have tokens."""
        size = None if self.sizes is None else self.sizes.shown
        return KeptPatches(self.shown, self.kept.device, self.shown_extents, size)

    @cached_property
    def subject(self) -> Rows:
        """The subject's pixels among those of all images."""
        if self.sizes is not None:
            return Rows.filled(self.masks.flatten(1), self.sizes.pixels, self.views)
        return Rows.exact(self.masks, [extent.count for extent in self.extents], 1)

    @cached_property
    def peers(self) -> Rows:
        """Recalibrated tokens among the packed ones, by element."""
        kept = self.kept
        everyone = self.tokens == "all"
        if self.sizes is not None:
            wanted = kept.mask if everyone else self.shown
            rows = Rows.filled(wanted.flatten(1), self.sizes.peers, self.views)
            return rows if kept.is_whole else dataclasses.replace(rows, index=kept.number[rows.index])
        if everyone:
            every = torch.ones_like(kept.index, dtype=torch.bool)
            return Rows.exact(every, kept.element_lengths(0), self.views)
        counts = _of_elements(self.shown_extents, self.views)
        return Rows.exact(self.shown.flatten()[kept.index], counts, self.views)

    @property
    def views(self) -> int:
        """Number of views of each element."""
        return self.masks.shape[1]

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of the subject's pixels in each element."""
        return _of_elements(self.extents, self.views)

    def trim(self, prediction: Prediction) -> Prediction:
        """Remove Gaussians that pad a shape bucket.

        On a GPU, Gaussians of pixels with a depth that is not finite remain, with opacity 0."""
        counts = self.counts
        if self.sizes is None or prediction.gaussians.splits != (self.sizes.pixels,) * len(counts):
            return prediction
        index = slice(0, counts[0]) if len(counts) == 1 else true_places(self.subject.real, sum(counts))
        return dataclasses.replace(prediction, gaussians=prediction.gaussians.select(index, counts))

    @property
    def is_bucket(self) -> bool:
        """Whether the plan has a shape bucket with at least one row for every image."""
        return self.sizes is not None and min(self.sizes.pixels, self.sizes.peers) >= self.views

    def bucket_extents(self) -> tuple[tuple[Extent, ...], tuple[Extent, ...]]:
        """Extents in each image of the subject, in pixels, and of the foreground patches, equal for every
        scene of the shape bucket: each image gets a share of its element's rows, in the common window."""
        grid = Window.whole(tuple(self.shown.shape[2:]))
        parts = ((self.sizes.pixels, self.windows_of(self.patch_size)[0]), (self.sizes.peers, grid))
        shared = []
        for size, window in parts:
            share = Extent(size // self.views, *window.rows[:2], *window.columns[:2])
            first = share._replace(count=size - (self.views - 1) * share.count)
            shared.append((first, *[share] * (self.views - 1)) * len(self.masks))
        return tuple(shared)

    @property
    def together(self) -> int:
        """Number of consecutive images whose maps are decoded together."""
        return 1 if self.sizes is None else self.views

    @property
    def depth_windows(self) -> list[Window | None] | None:
        """Windows of whole patches in which depths are needed; None: everywhere."""
        # Whole patches: the release's token points depend on pixels outside the mask.
        return None if "all" in (self.pixels, self.tokens) else self.windows_of(self.patch_size)

    @property
    def windows(self) -> list[Window | None] | None:
        """Window of the subject's pixels in each image; None: whole images are decoded."""
        return None if self.pixels == "all" else self.windows_of(1)

    def windows_of(self, cell: int) -> list[Window | None]:
        """Windows of whole cells around the subject of each image, None if it has none; with a shape
        bucket, its window."""
        size = tuple(self.masks.shape[2:])
        if self.sizes is not None:
            return [self.sizes.window.finer(self.patch_size, size)] * len(self.extents)
        return [
            window and window.coarser(cell).finer(cell, size)
            for window in subject_windows(self.extents, size)
        ]


def _of_elements(extents: Sequence[Extent], views: int) -> tuple[int, ...]:
    """Sums of counts over the images of each element."""
    each = [extent.count for extent in extents]
    return tuple([sum(each[first : first + views]) for first in range(0, len(each), views)])


@dataclass(frozen=True)
class MaskStatistics:
    """Statistics of masks from which a plan is made, as tensors on their device.

    Attributes:
        shown: foreground patches, those with a pixel of the subject.
        kept: patches that become tokens.
        numbers: counts of ``shown``, then :func:`ghgs_lit.extents.extent_numbers` of the masks and of
            ``kept``.
        flags: further values to copy to the host together with them.
    """

    shown: Bool[Tensor, "B V h w"]
    kept: Bool[Tensor, "B V h w"]
    numbers: tuple[Int[Tensor, "..."], ...]
    flags: tuple[Bool[Tensor, ""], ...] = ()

    @classmethod
    def of(
        cls,
        masks: Bool[Tensor, "B V H W"],
        patch_size: int,
        kept: Bool[Tensor, "B V h w"],
        flags: Sequence[Bool[Tensor, ""]] = (),
    ) -> "MaskStatistics":
        """Compute the statistics of masks.

        Args:
            masks: the subject's pixels; sides are divisible by the patch size.
            patch_size: in pixels.
            kept: patches that become tokens.
            flags: further values to copy to the host together with them.
        """
        shown = patches_around_subject(masks, patch_size, 0)
        extents = (extent_numbers(masks.flatten(0, 1)), extent_numbers(kept.flatten(0, 1)))
        return cls(shown, kept, (shown.flatten(2).sum(-1), *extents), tuple(flags))


def make_plan(
    masks: Bool[Tensor, "B V H W"],
    patch_size: int,
    kept: Bool[Tensor, "B V h w"] | MaskStatistics,
    pixels: DecodedPixels = "subject",
    tokens: DecodedPixels = "subject",
    flags: Sequence[Bool[Tensor, ""]] = (),
    in_buckets: bool | None = None,
    least: Sizes | None = None,
) -> Plan:
    """Make the plan of a batch, with the only device-to-host synchronisation.

    Args:
        masks: the subject's pixels; sides are divisible by the patch size.
        patch_size: in pixels.
        kept: patches that become tokens, or the complete statistics.
        pixels: pixels that dense heads decode.
        tokens: tokens that are recalibrated.
        flags: further tensors to read, after those of the statistics.
        in_buckets: round sizes up to shape buckets; None: on a GPU only.
        least: sizes of a shape bucket, reused if they suffice; None: sizes of the scene.
    """
    of_masks = kept if isinstance(kept, MaskStatistics) else MaskStatistics.of(masks, patch_size, kept)
    flags = (*of_masks.flags, *flags)
    stacked = [torch.stack(flags)] if flags else []
    counts, numbers, kept_numbers, *values = _read([*of_masks.numbers, *stacked])
    extents = _extents(numbers)
    kept_extents = _extents(kept_numbers)
    shown_extents = []
    for extent, count in zip(extents, counts, strict=True):
        shown_extents.append(extent.coarser(patch_size, count))
    is_whole = sum([extent.count for extent in kept_extents]) == of_masks.kept.numel()
    in_buckets = rounds_up(masks.device) if in_buckets is None else in_buckets
    sizes = None
    if in_buckets:
        kept_counts = [] if is_whole else [extent.count for extent in kept_extents]
        sizes = _bucket(tuple(masks.shape), patch_size, extents, shown_extents, kept_counts, tokens, least)
    patches = KeptPatches(of_masks.kept, masks.device, kept_extents, sizes and (sizes.kept or None))
    facts = (patch_size, pixels, tokens, tuple(map(bool, values[0])) if flags else (), sizes)
    return Plan(masks, of_masks.shown, patches, tuple(extents), tuple(shown_extents), *facts)


def _extents(numbers: Sequence[int]) -> list[Extent]:
    return [Extent(*numbers[first : first + 5]) for first in range(0, len(numbers), 5)]


def _bucket(
    shape: tuple[int, int, int, int],
    patch_size: int,
    extents: Sequence[Extent],
    shown: Sequence[Extent],
    kept: Sequence[int],
    tokens: DecodedPixels,
    least: Sizes | None,
) -> Sizes:
    """Compute the shape bucket of a scene from the extents of masks and of foreground patches (``shown``),
    and the counts of kept patches (empty: all)."""

    def rows(name: str, counts: Sequence[int], most: int) -> int:
        needed = max(1, *counts)
        known = 0 if least is None else getattr(least, name)
        if known < needed:
            known = math.ceil(_SPARE * needed) if known else needed
        return min(bucket_size(known), most)

    views, *size = shape[1:]
    grid = (size[0] // patch_size, size[1] // patch_size)
    patches = grid[0] * grid[1]
    of_image = rows("kept", kept, patches) if kept else 0
    peers = [views * (of_image or patches)] if tokens == "all" else _of_elements(shown, views)
    seen = [window.coarser(patch_size) for window in subject_windows(extents, tuple(size)) if window]
    window = functools.reduce(Window.hull, seen) if seen else Window(*(Span(0, 1, full) for full in grid))
    if least is not None:
        both = least.window.hull(window)
        window = both if both == least.window else both.grow(1)
    return Sizes(
        rows("pixels", _of_elements(extents, views), views * size[0] * size[1]),
        rows("peers", peers, views * patches),
        of_image,
        rows("shown", [extent.count for extent in shown], patches),
        Window(*(span.widen() for span in window)),
    )


def _read(tensors: Sequence[Tensor]) -> list[list[int]]:
    """Read the values of integer tensors, those on a GPU with one copy."""
    there = [tensor.flatten() for tensor in tensors if tensor.device.type != "cpu"]
    values = iter(torch.cat(there).tolist() if there else ())
    read = []
    for tensor in tensors:
        is_here = tensor.device.type == "cpu"
        read.append(tensor.flatten().tolist() if is_here else list(islice(values, tensor.numel())))
    return read
