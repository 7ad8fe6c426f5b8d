"""The plan of a batch, and the one place where a prediction reads from a GPU what its
masks hold."""

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
from ghgs_lit.method.plan.rows import Rows, rounds_up, rows_of_group
from ghgs_lit.method.plan.window import Span, Window, subject_windows
from ghgs_lit.types import DecodedPixels, Prediction


@dataclass(frozen=True)
class Sizes:
    """What is the same for all scenes of a class.

    Attributes:
        pixels: rows of the subject's pixels, of each element.
        peers: rows of the tokens that are recalibrated, of each element.
        kept: rows of the patches that become tokens, of each image; 0: all patches do.
        shown: rows of the patches that show the subject, of each image.
        window: patches in which every subject lies; None: it is not known yet.
    """

    pixels: int
    peers: int
    kept: int
    shown: int
    window: Window

    def held(self, name: str, needed: int) -> int:
        """A size as long as it is enough, then what is needed with room to spare.

        Args:
            name: of the size.
            needed: rows.
        """
        own = getattr(self, name)
        return own if own >= needed else math.ceil(_SPARE * needed) if own else needed


#: Room that sizes get where those before were too small.
_SPARE = 1.15
#: Nothing is held.
_NOTHING = Sizes(0, 0, 0, 0, None)


@dataclass(frozen=True)
class Plan:
    """What the stages work on.

    Attributes:
        masks: the subject's pixels.
        shown: patches with a pixel of the subject.
        kept: patches that become tokens.
        extents: of the subject in each image ``b * V + v``.
        shown_extents: of the patches ``shown``, in patches.
        patch_size: in pixels.
        pixels: pixels that dense heads decode; ``all``: whole views.
        tokens: tokens that are recalibrated;
            ``all``: with those of the background, which need depths, too.
        classes: numbers of rows, and windows, are size classes (:mod:`ghgs_lit.method.plan.rows`).
        flags: values of further tensors that were read with the masks.
        least: sizes that are kept as long as they are enough.
        is_least: sizes are these, whatever the scene."""

    masks: Bool[Tensor, "B V H W"]
    shown: Bool[Tensor, "B V h w"]
    kept: KeptPatches
    extents: tuple[Extent, ...]
    shown_extents: tuple[Extent, ...]
    patch_size: int
    pixels: DecodedPixels = "subject"
    tokens: DecodedPixels = "subject"
    classes: bool = False
    flags: tuple[bool, ...] = ()
    least: Sizes = _NOTHING
    is_least: bool = False

    def _held(self, name: str, counts: Sequence[int]) -> int:
        """Number of rows for groups of some counts."""
        if self.is_least:
            return getattr(self.least, name)
        return self.least.held(name, max(1, *counts))

    @cached_property
    def shown_patches(self) -> KeptPatches:
        """The patches ``shown``, each of which has a token."""
        size = self._shown_size if self.classes else None
        return KeptPatches(self.shown, self.kept.device, self.shown_extents, size)

    @property
    def sizes(self) -> Sizes:
        """The sizes of the scene's class."""
        rows = (self._pixel_rows, self._peer_rows)
        return Sizes(*rows, self.kept.size or 0, self._shown_size, self._patches)

    @property
    def _pixel_rows(self) -> int:
        """Rows of each element's pixels in ``classes``."""
        return rows_of_group([self._held("pixels", self.counts)], self.masks[0].numel())

    @property
    def _peer_rows(self) -> int:
        """Rows of each element's recalibrated tokens in ``classes``."""
        return rows_of_group([self._held("peers", self._peer_counts)], self.shown[0].numel())

    @property
    def _peer_counts(self) -> Sequence[int]:
        """Number of tokens of each element that are recalibrated."""
        everyone = self.tokens == "all"
        return self.kept.element_lengths(0) if everyone else self._of_elements(self.shown_extents)

    @property
    def _shown_size(self) -> int:
        return _of_image(self._held("shown", [extent.count for extent in self.shown_extents]), self.shown)

    @cached_property
    def subject(self) -> Rows:
        """The subject's pixels among those of all images."""
        if self.classes:
            return Rows.filled(self.masks.flatten(1), [self._pixel_rows], self.views)
        return Rows.exact(self.masks, [extent.count for extent in self.extents], 1)

    @cached_property
    def peers(self) -> Rows:
        """Tokens that are recalibrated, among the packed ones, by element."""
        everyone = self.tokens == "all"
        if self.classes:
            wanted = self.kept.mask if everyone else self.shown
            rows = Rows.filled(wanted.flatten(1), [self._peer_rows], self.views)
            kept = self.kept
            return rows if kept.is_whole else dataclasses.replace(rows, index=kept.number[rows.index])
        every = torch.ones_like(self.kept.index, dtype=torch.bool)
        wanted = every if everyone else self.shown.flatten()[self.kept.index]
        return Rows.exact(wanted, self._peer_counts, self.views)

    @property
    def views(self) -> int:
        """Number of views of each element."""
        return self.masks.shape[1]

    @property
    def counts(self) -> tuple[int, ...]:
        """Number of the subject's pixels in each element."""
        return self._of_elements(self.extents)

    def _of_elements(self, extents: Sequence[Extent]) -> tuple[int, ...]:
        """Sums of the counts of each element's images."""
        each = [extent.count for extent in extents]
        return tuple(sum(each[first : first + self.views]) for first in range(0, len(each), self.views))

    def trimmed(self, prediction: Prediction) -> Prediction:
        """The prediction with Gaussians for the subject's pixels alone.

        Args:
            prediction: Gaussians, and drafts of the rounds, may fill a size class.

        Returns:
            On a GPU those of pixels whose depth is not finite stay, with opacity 0.
        """
        filled = (self._pixel_rows,) * len(self.counts) if self.classes else None
        if prediction.gaussians.splits != filled:
            return prediction
        if len(self.counts) == 1:
            index = slice(0, self.counts[0])
        else:
            index = true_places(self.subject.real, sum(self.counts))
        every = (prediction.gaussians, *prediction.drafts)
        gaussians, *drafts = (each.select(index, self.counts) for each in every)
        return dataclasses.replace(prediction, gaussians=gaussians, drafts=tuple(drafts))

    @property
    def is_of_class(self) -> bool:
        """Whether sizes are those of a class, and every image can have a row of it."""
        return self.classes and min(self._pixel_rows, self._peer_rows) >= self.views

    def extents_of_class(self) -> tuple[tuple[Extent, ...], tuple[Extent, ...]]:
        """Extents with which a plan has the same sizes and windows for every scene of the class.

        Each image has a share of its element's rows, in the window of all.

        Returns:
            Extents of the subject in pixels, and of the patches that show it, of each image.
        """
        window = self._windows(self.patch_size)[0]
        grid = Window.whole(tuple(self.shown.shape[2:]))
        return self._shared(self._pixel_rows, window), self._shared(self._peer_rows, grid)

    def _shared(self, size: int, window: Window) -> tuple[Extent, ...]:
        """Rows of each element, ``size`` in number, shared by its images in one window."""
        share = Extent(size // self.views, *window.rows[:2], *window.columns[:2])
        first = share._replace(count=size - (self.views - 1) * share.count)
        return (first, *[share] * (self.views - 1)) * len(self.counts)

    @property
    def together(self) -> int:
        """Number of consecutive images whose maps are decoded in one part."""
        return self.views if self.classes else 1

    @property
    def depth_windows(self) -> list[Window | None] | None:
        """Windows in which depths are needed, of whole patches; None: everywhere."""
        # Whole patches: the token points of the release depend on pixels beside the mask.
        return None if "all" in (self.pixels, self.tokens) else self._windows(self.patch_size)

    @property
    def windows(self) -> list[Window | None] | None:
        """Windows with the subject's pixels of each image; None: whole images are decoded."""
        return None if self.pixels == "all" else self._windows(self.patch_size if self.classes else 1)

    def _windows(self, cell: int) -> list[Window | None]:
        """Windows of whole cells around the subject, None without one;
        of ``classes`` the same for all."""
        size = tuple(self.masks.shape[2:])
        each = subject_windows(self.extents, size)
        whole_cells = [window and window.coarser(cell).finer(cell, size) for window in each]
        if not self.classes:
            return whole_cells
        return [self._patches.finer(cell, size)] * len(whole_cells)

    @cached_property
    def _patches(self) -> Window:
        """Patches around all subjects, as many as a size class has."""
        size = tuple(self.masks.shape[2:])
        seen = [window.coarser(self.patch_size) for window in subject_windows(self.extents, size) if window]
        grid = tuple(self.shown.shape[2:])
        spans = functools.reduce(Window.hull, seen) if seen else Window(*(Span(0, 1, full) for full in grid))
        if self.least.window is not None:
            both = self.least.window.hull(spans)
            spans = both if both == self.least.window else both.grown(1)
        return Window(*(span.widened() for span in spans))


def _of_image(rows: int, patches: Bool[Tensor, "B V h w"]) -> int:
    """The size class of rows of an image, which needs no more than it has patches."""
    return min(bucket_size(rows), patches.shape[-2] * patches.shape[-1])


@dataclass(frozen=True)
class Measured:
    """What masks say, where they are: a function of tensors, before anything is read.

    Attributes:
        shown: patches with a pixel of the subject.
        kept: patches that become tokens.
        numbers: of the patches ``shown``, then :func:`ghgs_lit.extents.extent_numbers` of the masks
            and of ``kept``.
        flags: further values that are read with them.
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
    ) -> "Measured":
        """What these masks say.

        Args:
            masks: the subject's pixels; sides are divisible by the patch size.
            patch_size: in pixels.
            kept: patches that become tokens.
            flags: further values that are read with them.
        """
        shown = patches_around_subject(masks, patch_size, 0)
        numbers = [shown.flatten(2).sum(-1)]
        numbers += [extent_numbers(each.flatten(0, 1)) for each in (masks, kept)]
        return cls(shown, kept, tuple(numbers), tuple(flags))


def planned(
    masks: Bool[Tensor, "B V H W"],
    patch_size: int,
    kept: Bool[Tensor, "B V h w"] | Measured,
    pixels: DecodedPixels = "subject",
    tokens: DecodedPixels = "subject",
    flags: Sequence[Bool[Tensor, ""]] = (),
    classes: bool | None = None,
    least: Sizes | None = None,
) -> Plan:
    """The plan of a batch. The host waits for a GPU once.

    Args:
        masks: the subject's pixels; sides are divisible by the patch size.
        patch_size: in pixels.
        kept: patches that become tokens; or all that is measured of them and the masks.
        pixels: of the preset.
        tokens: which ones the recalibration works on.
        flags: tensors whose values are to be read with those that are measured, and after them.
        classes: whether numbers of rows are size classes; None: as the masks' device needs it.
        least: as of :class:`Plan`; None: nothing is held.
    """
    least = least or _NOTHING
    measured = kept if isinstance(kept, Measured) else Measured.of(masks, patch_size, kept)
    shown = measured.shown
    kept = measured.kept
    flags = (*measured.flags, *flags)
    counts, *values = _read([*measured.numbers, *([torch.stack(flags)] if flags else [])])
    of_masks = []
    for rows in values[:2]:
        firsts = range(0, len(rows), 5)
        of_masks.append(tuple(Extent(*rows[first : first + 5]) for first in firsts))
    extents, kept_extents = of_masks
    shown_extents = tuple(e.coarser(patch_size, n) for e, n in zip(extents, counts, strict=True))
    known = tuple(map(bool, values[-1])) if flags else ()
    classes = rounds_up(masks.device) if classes is None else classes
    is_whole = sum(extent.count for extent in kept_extents) == kept.numel()
    size = None
    if classes and not is_whole:
        size = _of_image(least.held("kept", max(1, *(extent.count for extent in kept_extents))), kept)
    patches = KeptPatches(kept, masks.device, kept_extents, size)
    facts = (extents, shown_extents, patch_size, pixels, tokens, classes, known, least)
    return Plan(masks, shown, patches, *facts)


def _read(tensors: Sequence[Tensor]) -> list[list[int]]:
    """The values of integer tensors; of all that are not on the CPU at once."""
    there = [tensor.flatten() for tensor in tensors if tensor.device.type != "cpu"]
    values = iter(torch.cat(there).tolist() if there else ())
    read = []
    for tensor in tensors:
        is_here = tensor.device.type == "cpu"
        read.append(tensor.flatten().tolist() if is_here else list(islice(values, tensor.numel())))
    return read
