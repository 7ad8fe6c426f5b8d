"""Coarse to fine: depths of smaller copies of the photographs are where the rounds at full size start.

The stages judge a pixel by what they see around it, in pixels. Where a person is taller than in training they
see less of it and place it worse. So the whole method runs once on copies in which the subject has the height
that the weights know, and its depths are refined at full size, as in cascades of cost volumes (CasMVSNet, Gu
et al., CVPR 2020). What is decided here depends on an element's own masks alone.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.masks import coverage
from ghgs_lit.geometry.padding import PaddedBatch
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.types import Batch, DepthBounds, DepthMaps, map_tensors

#: Subjects that are less than this many times as tall as the weights know them are predicted at once: in
#: photographs of the size of the training, which a subject may fill, nothing changes.
WORTH = 1.3
#: First steps of the rounds, in those of rounds that start from a depth head: a coarse depth is nearly right.
STEP = 0.5
#: Share of a pixel that a mask without a matte must cover in a smaller copy.
_COVERED = 0.5

#: Height and width in pixels.
Size = tuple[int, int]


@dataclass(frozen=True)
class CoarseDepths:
    """Depths that coarse predictions found for some elements of a batch.

    Attributes:
        depth: in metres; meaningless in other elements.
        confidence: of the coarse depth head.
        elements: which elements have depths.
    """

    depth: Float[Tensor, "B V H W"]
    confidence: Float[Tensor, "B V H W"]
    elements: tuple[bool, ...]

    @property
    def are_all(self) -> bool:
        """Whether all elements have depths, so that no depth head is needed."""
        return all(self.elements)

    @property
    def step(self) -> float | Float[Tensor, " B"]:
        """Size of the first step of the rounds in each element, or in all."""
        if self.are_all:
            return STEP
        return self.depth.new_tensor([STEP if known else 1.0 for known in self.elements])

    def maps(self, batch: Batch, bounds: DepthBounds, others: DepthMaps | None = None) -> DepthMaps:
        """The depths within bounds, in the middle where nothing is known.

        Args:
            batch: its masks say which pixels are valid.
            bounds: in metres.
            others: depths of the elements without coarse ones; None: all elements have some.
        """
        depth = torch.where(self.depth > 0, self.depth, (bounds.near + bounds.far) / 2)
        depth = torch.minimum(torch.maximum(depth, bounds.near), bounds.far)
        coarse = DepthMaps(depth, batch.masks, self.confidence, bounds)
        if others is None:
            return coarse
        known = torch.tensor(self.elements, device=depth.device)[:, None, None, None]
        parts = {
            name: torch.where(known, getattr(coarse, name), getattr(others, name))
            for name in ("depth", "valid", "confidence")
        }
        return DepthMaps(**parts, bounds=bounds)


def coarse_depths(
    batch: Batch,
    height: int,
    patch_size: int,
    least_matte: float | None,
    predict: Callable[[Batch], DepthMaps],
) -> CoarseDepths | None:
    """Depths from smaller copies of the photographs; None where no subject is tall enough to need them.

    Args:
        batch: as the stages see it, with or without a border around the photographs.
        height: pixels of the subject's height, or of its width if larger, that the weights know.
        patch_size: of the encoder, in pixels; sides of the copies are its multiples.
        least_matte: share of a pixel above which it belongs to the subject, 0 to 0.5; None: there are
            none.
        predict: gives the final depth maps of a batch.

    Returns:
        Depths at the size of ``batch``, in metres.
    """
    photographs = batch.photographs if isinstance(batch, PaddedBatch) else batch
    sizes = coarse_sizes(photographs, height, patch_size)
    wanted = sorted({size for size in sizes if size is not None})
    if not wanted:
        return None
    full = tuple(photographs.masks.shape[2:])
    depths = at_least_float32(photographs.images).new_zeros(2, *photographs.masks.shape)
    for size in wanted:
        chosen = torch.tensor([i for i, own in enumerate(sizes) if own == size], device=depths.device)
        maps = predict(shrunk(_elements(photographs, chosen), size, least_matte))
        grown = torch.stack((enlarged(maps, full), _resized(maps.confidence, full)))
        depths = depths.index_copy(1, chosen, grown.to(depths.dtype))
    if isinstance(batch, PaddedBatch):
        depths = torch.stack([batch.padding.pad(each) for each in depths])
    return CoarseDepths(*depths, tuple(size is not None for size in sizes))


def coarse_sizes(batch: Batch, height: int, patch_size: int) -> list[Size | None]:
    """The size of each element's smaller copy; None for elements that need none.

    Args:
        batch: photographs of one size, without a border.
        height: pixels of the subject that the weights know.
        patch_size: sides are its multiples, in pixels.
    """
    views = batch.masks.shape[1]
    full = batch.masks.shape[2:]
    sizes: list[Size | None] = []
    for first in range(0, len(batch.extents), views):
        seen = [extent for extent in batch.extents[first : first + views] if extent.count]
        tallest = max((max(e.bottom - e.top, e.right - e.left) for e in seen), default=0)
        if tallest < WORTH * height:
            sizes.append(None)
        else:
            sizes.append(
                tuple(max(round(side * height / tallest / patch_size), 1) * patch_size for side in full)
            )
    return sizes


def shrunk(batch: Batch, size: Size, least_matte: float | None) -> Batch:
    """The batch with smaller photographs, mattes and masks, and their cameras.

    Args:
        batch: photographs without a border; true depths and targets are left out.
        size: height and width of the copies, in pixels.
        least_matte: share of a pixel above which it belongs to the subject, with mattes."""
    images = _resized(at_least_float32(batch.images).flatten(0, 1), size).unflatten(0, batch.masks.shape[:2])
    shares = _resized(coverage(batch), size).clamp(0, 1)
    has_matte = batch.alpha is not None
    return dataclasses.replace(
        batch,
        images=images.clamp(0, 1),
        masks=shares > least_matte if has_matte else shares >= _COVERED,
        alpha=shares if has_matte else None,
        cameras=batch.cameras.resized(*size),
        depths=None,
        targets=None,
    )


def enlarged(maps: DepthMaps, size: Size) -> Float[Tensor, "B V H W"]:
    """Depths at another size. Inverse depths are interpolated, which is exact for planes.

    Args:
        maps: depths in metres, and where they are valid.
        size: height and width in pixels.

    Returns:
        Depths in metres, 0 where nothing near is known.
    """
    depth = at_least_float32(maps.depth)
    inverse = torch.where(maps.valid, 1 / torch.where(maps.valid, depth, 1), 0)
    # One pixel around what is known: a finger may lie within the photograph's mask and outside the copy's.
    weight, around = (F.avg_pool2d(values, 3, 1, 1) for values in (maps.valid.to(depth.dtype), inverse))
    inverse = torch.where(maps.valid, inverse, around / torch.where(weight > 0, weight, 1))
    weight = _resized((weight > 0).to(depth.dtype), size)
    inverse = _resized(inverse, size)
    return torch.where(inverse > 0, weight / torch.where(inverse > 0, inverse, 1), 0)


def _resized(maps: Float[Tensor, "B c H W"], size: Size) -> Float[Tensor, "B c h w"]:
    return F.interpolate(maps, size, mode="bilinear", antialias=True)


def _elements(batch: Batch, chosen: Tensor) -> Batch:
    """Photographs of some elements, without targets and true depths."""
    alone = dataclasses.replace(batch, targets=None, depths=None, body_vertices=None, subjects=(), views=())
    return map_tensors(alone, lambda values: values[chosen])
