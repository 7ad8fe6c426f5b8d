"""The plan of a batch, and the one place where a prediction reads from a GPU what its masks hold."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.plan.patches import KeptPatches
from ghgs_lit.plan.rows import Rows
from ghgs_lit.plan.window import Window, subject_windows
from ghgs_lit.types import Decision, DecodedPixels, Extent, extent_numbers

#: From the numbers of patches [B, V] that each of several presets keeps: each element's decision, and the
#: number of its preset.
Choose = Callable[[Sequence[Float[Tensor, "B V"]]], tuple[tuple[Decision, ...], Sequence[int]]]


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
        tokens: tokens that are recalibrated; ``all``: with those of the background, which need depths, too.
        decisions: what ``skip=auto`` chose for each element.
        flags: values of further tensors that were read with the masks."""

    masks: Bool[Tensor, "B V H W"]
    shown: Bool[Tensor, "B V h w"]
    kept: KeptPatches
    extents: tuple[Extent, ...]
    shown_extents: tuple[Extent, ...]
    patch_size: int
    pixels: DecodedPixels = "subject"
    tokens: DecodedPixels = "subject"
    decisions: tuple[Decision, ...] = ()
    flags: tuple[bool, ...] = ()

    @cached_property
    def shown_patches(self) -> KeptPatches:
        """The patches ``shown``, each of which has a token."""
        return KeptPatches(self.shown, self.kept.index.device, self.shown_extents)

    @cached_property
    def subject(self) -> Rows:
        """The subject's pixels among those of all images."""
        return Rows.exact(self.masks, [extent.count for extent in self.extents], 1)

    @cached_property
    def peers(self) -> Rows:
        """Tokens that are recalibrated, among the packed ones, by element."""
        views = self.masks.shape[1]
        if self.tokens == "all":
            wanted, counts = torch.ones_like(self.kept.index, dtype=torch.bool), self.kept.element_lengths(0)
        else:
            wanted = self.shown.flatten()[self.kept.index]
            each = [extent.count for extent in self.shown_extents]
            counts = [sum(each[first : first + views]) for first in range(0, len(each), views)]
        return Rows.exact(wanted, counts, views)

    @property
    def depth_windows(self) -> list[Window | None] | None:
        """Windows in which depths are needed, of whole patches; None: everywhere."""
        if "all" in (self.pixels, self.tokens):
            return None
        # Whole patches: the token points of the release depend on pixels beside the mask.
        p, size = self.patch_size, tuple(self.masks.shape[2:])
        return [window and window.coarser(p).finer(p, size) for window in subject_windows(self.extents, size)]

    @property
    def windows(self) -> list[Window | None] | None:
        """Windows with the subject's pixels of each image; None: whole images are decoded."""
        if self.pixels == "all":
            return None
        return subject_windows(self.extents, tuple(self.masks.shape[2:]))


def planned(
    masks: Bool[Tensor, "B V H W"],
    patch_size: int,
    choices: Sequence[Bool[Tensor, "B V h w"]],
    pixels: DecodedPixels = "subject",
    tokens: DecodedPixels = "subject",
    choose: Choose | None = None,
    flags: Sequence[Bool[Tensor, ""]] = (),
) -> Plan:
    """The plan of a batch. The host waits for a GPU once.

    Args:
        masks: the subject's pixels; sides are divisible by the patch size.
        patch_size: in pixels.
        choices: patches that become tokens; of several presets if ``choose`` is there.
        pixels: of the preset.
        tokens: which ones the recalibration works on.
        choose: gives each element one of the ``choices``; None: all get the first.
        flags: tensors whose values are to be read with those of the masks."""
    b, v = masks.shape[:2]
    shown = patches_around_subject(masks, patch_size, 0)
    images, *grids = (each.flatten(0, 1) for each in (masks, shown, *choices))
    numbers = [extent_numbers(images), *map(extent_numbers, grids)]
    found = _read([*numbers, *(flag.long() for flag in flags)])
    count = len(numbers)
    extents, shown_extents, *of_choices = (
        tuple(Extent(*values[first : first + 5]) for first in range(0, len(values), 5))
        for values in found[:count]
    )
    decisions, kept, kept_extents = (), choices[0], of_choices[0]
    if choose is not None:
        sizes = [torch.tensor([e.count for e in each], device="cpu").view(b, v) for each in of_choices]
        decisions, best = choose(sizes)
        kept = torch.stack([choices[number][element].to(masks.device) for element, number in enumerate(best)])
        each = [of_choices[best[image // v]][image] for image in range(b * v)]
        kept_extents = tuple(each)
    patches = KeptPatches(kept, masks.device, kept_extents)
    known = tuple(bool(values[0]) for values in found[count:])
    return Plan(masks, shown, patches, extents, shown_extents, patch_size, pixels, tokens, decisions, known)


def _read(tensors: Sequence[Tensor]) -> list[list[int]]:
    """The values of integer tensors; of all that are not on the CPU at once."""
    there = [tensor.flatten() for tensor in tensors if tensor.device.type != "cpu"]
    values = iter(torch.cat(there).tolist() if there else ())
    return [
        tensor.flatten().tolist() if tensor.device.type == "cpu" else list(islice(values, tensor.numel()))
        for tensor in tensors
    ]
