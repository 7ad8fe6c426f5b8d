"""Coarse to fine: predictions from downsampled views initialise the rounds at full size.

The stages have a receptive field of a fixed number of pixels. If a person is taller than in
training, the field covers less of them, and depths are less accurate. So the whole method runs once
on downsampled copies in which the subject has the height of the training. The resulting depths are
refined at full size, as in cascades of cost volumes (CasMVSNet, Gu et al., CVPR 2020), and the
resulting tokens replace those of the encoder, which does not run at full size. All decisions depend
only on an element's own masks and the size of the images.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.masks import coverage
from ghgs_lit.geometry.padding import PaddedBatch
from ghgs_lit.geometry.projection import at_least_float32, pixel_centers
from ghgs_lit.method.plan import Plan
from ghgs_lit.types import Batch, DepthBounds, DepthMaps, Prediction, Tokens, map_tensors

#: Fraction of an image's side that a person fills in training; images of that size are not copied.
FILLED = 0.8
#: Factor of the rounds' first step in depth, compared with rounds after a depth head: a coarse depth
#: is nearly right.
STEP = 0.5
#: Fraction of a pixel that a mask without a matte must cover in a downsampled copy.
_COVERED = 0.5

#: Height and width in pixels.
Size = tuple[int, int]


@dataclass(frozen=True)
class CoarseDepths:
    """Depths of coarse predictions for some elements of a batch.

    Attributes:
        depth: in metres; meaningless in other elements.
        confidence: confidence of the coarse depth head.
        elements: which elements have coarse depths.
    """

    depth: Float[Tensor, "B V H W"]
    confidence: Float[Tensor, "B V H W"]
    elements: tuple[bool, ...]

    @property
    def are_all(self) -> bool:
        """Whether all elements have coarse depths, so that no depth head is needed."""
        return all(self.elements)

    @property
    def step(self) -> float | Float[Tensor, " B"]:
        """Factor of the rounds' first step in depth, for all elements or for each."""
        if self.are_all:
            return STEP
        steps = tuple(STEP if known else 1.0 for known in self.elements)
        return constant(torch.tensor, steps, like=self.depth)

    @property
    def known(self) -> Bool[Tensor, " B"]:
        """:attr:`elements` as a tensor on the depths' device."""
        return constant(torch.tensor, self.elements, like=self.depth, dtype=torch.bool)

    def maps(self, batch: Batch, bounds: DepthBounds, others: DepthMaps | None = None) -> DepthMaps:
        """Clamp the depths to bounds; unknown ones become the middle of the bounds.

        Args:
            batch: its masks define the valid pixels.
            bounds: in metres.
            others: depths of the elements without coarse ones; None: all elements have coarse depths.
        """
        depth = torch.where(self.depth > 0, self.depth, (bounds.near + bounds.far) / 2)
        depth = torch.minimum(torch.maximum(depth, bounds.near), bounds.far)
        coarse = DepthMaps(depth, batch.masks, self.confidence, bounds)
        if others is None:
            return coarse
        known = self.known[:, None, None, None]
        parts = {
            name: torch.where(known, getattr(coarse, name), getattr(others, name))
            for name in ("depth", "valid", "confidence")
        }
        return DepthMaps(**parts, bounds=bounds)


@dataclass(frozen=True)
class Coarse:
    """Results of predictions from downsampled views for use at full size.

    Attributes:
        depths: depths of the elements that have downsampled copies.
        tokens: tokens of every patch at full size, interpolated from those of the copies; meaningless
            in other elements.
    """

    depths: CoarseDepths
    tokens: Tokens

    def encoder(self, encoder: Callable[..., Tokens]) -> Callable[..., Tokens]:
        """Wrap an encoder: elements with a copy use its tokens; ``encoder`` is called only if there are
        others."""
        return functools.partial(self._encode, encoder)

    def depth_head(self, head: Callable[..., DepthMaps]) -> Callable[..., DepthMaps]:
        """Wrap a depth head: elements with a copy use its depths; ``head`` is called only if there are
        others."""
        return functools.partial(self._decode, head)

    def _decode(
        self,
        head: Callable[..., DepthMaps],
        tokens: Tokens,
        batch: Batch,
        bounds: DepthBounds | None,
        plan: Plan,
    ) -> DepthMaps:
        others = None if self.depths.are_all else head(tokens, batch, bounds, plan)
        return self.depths.maps(batch, bounds, others)

    def _encode(
        self,
        encoder: Callable[..., Tokens],
        images: Tensor,
        masks: Tensor,
        bounds: DepthBounds | None,
        plan: Plan,
    ) -> Tokens:
        kept = plan.kept
        tokens = self.tokens
        if not kept.is_whole:
            tokens = dataclasses.replace(tokens.select(kept.index), real=kept.real)
        if self.depths.are_all:
            return tokens
        others = encoder(images, masks, bounds, plan)
        known = self.depths.known[others.image // others.grid[1], None]
        pairs = zip((*tokens.latent, tokens.semantic), (*others.latent, others.semantic), strict=True)
        *latent, semantic = (torch.where(known, own, other) for own, other in pairs)
        return dataclasses.replace(others, latent=tuple(latent), semantic=semantic)


def coarse_of(
    batch: Batch,
    height: int,
    patch_size: int,
    least_matte: float | None,
    predict: Callable[[Batch], Prediction],
) -> Coarse | None:
    """Predict from downsampled views; None if no subject is taller than in training.

    Args:
        batch: preprocessed, with or without padding.
        height: height of the subject in training in pixels, or its width if larger.
        patch_size: patch size of the encoder in pixels; sides of the copies are its multiples.
        least_matte: matte above which a pixel belongs to the subject, 0 to 0.5; None: no mattes.
        predict: predicts from a batch, and returns the tokens of the encoder as well.

    Returns:
        Depths in metres and tokens at the size of ``batch``.
    """
    photographs = batch.photographs if isinstance(batch, PaddedBatch) else batch
    sizes = coarse_sizes(photographs, height, patch_size)
    wanted = sorted({size for size in sizes if size is not None})
    if not wanted:
        return None
    full = tuple(photographs.masks.shape[2:])
    depths = at_least_float32(photographs.images).new_zeros(2, *photographs.masks.shape)
    rows = None
    for size in wanted:
        numbers = tuple(i for i, own in enumerate(sizes) if own == size)
        chosen = constant(torch.tensor, numbers, like=depths, dtype=torch.long)
        prediction = predict(shrink(_elements(photographs, chosen), size, least_matte))
        maps = prediction.depth_maps
        grown = torch.stack((enlarge(maps, full), _resize(maps.confidence, full)))
        depths = depths.index_copy(1, chosen, grown.to(depths.dtype))
        spread = spread_tokens(prediction.tokens, batch, patch_size)
        rows = spread.new_zeros(len(sizes), *spread.shape[1:]) if rows is None else rows
        rows = rows.index_copy(0, chosen, spread)
    if isinstance(batch, PaddedBatch):
        depths = torch.stack([batch.padding.pad(each) for each in depths])
    of_elements = tuple(size is not None for size in sizes)
    return Coarse(CoarseDepths(*depths, of_elements), _pack(rows, prediction.tokens))


def coarse_sizes(batch: Batch, height: int, patch_size: int) -> list[Size | None]:
    """Size of each element's downsampled copy; None for elements that need none.

    A copy is needed if the subject is taller than in training and the images are larger than those of
    the training, which subjects may fill. Each element is decided independently.

    Args:
        batch: images of one size, with or without padding.
        height: height of the subject in training, in pixels.
        patch_size: in pixels; sides of the copies are its multiples.
    """
    photographs = batch.photographs if isinstance(batch, PaddedBatch) else batch
    views, *full = photographs.masks.shape[1:]
    sizes: list[Size | None] = []
    for first in range(0, len(photographs.extents), views):
        tallest = 0
        for extent in photographs.extents[first : first + views]:
            if extent.count:
                tallest = max(tallest, extent.bottom - extent.top, extent.right - extent.left)
        size = None
        if tallest > height and FILLED * max(full) > height:
            scale = height / tallest
            size = tuple([max(round(side * scale / patch_size), 1) * patch_size for side in full])
        sizes.append(None if size is None or max(size) >= max(full) else size)
    return sizes


def spread_tokens(tokens: Tokens, batch: Batch, patch_size: int) -> Float[Tensor, "b V h w c"]:
    """Interpolate tokens of downsampled copies bilinearly, among existing ones, for every patch at full size.

    Args:
        tokens: tokens of the copies of some elements.
        batch: at full size, with or without padding.
        patch_size: of the encoder, in pixels.

    Returns:
        Concatenated layers and semantic features; 0 where no token is near.
    """
    ones = torch.ones_like(tokens.semantic[:, :1])
    rows = torch.cat((*tokens.latent, tokens.semantic, ones), -1)
    maps = at_least_float32(dataclasses.replace(tokens, latent=(rows,)).maps(0))
    top, left = (batch.padding.top, batch.padding.left) if isinstance(batch, PaddedBatch) else (0, 0)
    photographs = batch.photographs if isinstance(batch, PaddedBatch) else batch
    height, width = photographs.masks.shape[2:]
    grid = [side // patch_size for side in batch.masks.shape[2:]]
    places = patch_size * pixel_centers(*grid, maps) + constant(torch.tensor, (left, top), like=maps)
    places = 2 / constant(torch.tensor, (width, height), like=maps) * places - 1
    places = places.expand(len(maps), -1, -1, -1)
    values = F.grid_sample(maps, places, padding_mode="border", align_corners=False)
    values, weight = values[:, :-1], values[:, -1:]
    values = values / torch.where(weight > 0, weight, 1)
    return values.permute(0, 2, 3, 1).unflatten(0, tokens.grid[:2])


def _pack(rows: Float[Tensor, "B V h w c"], like: Tokens) -> Tokens:
    """Build tokens of every patch from concatenated layers and semantic features, with the widths and
    dtypes of ``like``."""
    grid = tuple(rows.shape[:4])
    parts = (*like.latent, like.semantic)
    split = rows.flatten(0, 3).split([part.shape[1] for part in parts], -1)
    *latent, semantic = (own.to(part.dtype) for own, part in zip(split, parts, strict=True))
    number = torch.arange(len(semantic), device=rows.device)
    image = number // (grid[2] * grid[3])
    row = number // grid[3] % grid[2]
    return Tokens(tuple(latent), semantic, image, row, number % grid[3], grid, like.patch_size)


def shrink(batch: Batch, size: Size, least_matte: float | None) -> Batch:
    """Downsample images, mattes, masks and cameras of a batch; true depths and targets are dropped.

    Args:
        batch: images without padding.
        size: height and width of the copies, in pixels.
        least_matte: matte above which a pixel belongs to the subject, for batches with mattes."""
    images = _resize(at_least_float32(batch.images).flatten(0, 1), size).unflatten(0, batch.masks.shape[:2])
    shares = _resize(coverage(batch), size).clamp(0, 1)
    has_matte = batch.alpha is not None
    return dataclasses.replace(
        batch,
        images=images.clamp(0, 1),
        masks=shares > least_matte if has_matte else shares >= _COVERED,
        alpha=shares if has_matte else None,
        cameras=batch.cameras.resize(*size),
        depths=None,
        targets=None,
    )


def enlarge(maps: DepthMaps, size: Size) -> Float[Tensor, "B V H W"]:
    """Resample depths in metres to another size; 0 where no valid depth is near.

    Inverse depths are interpolated, which is exact for planes.

    Args:
        maps: depths in metres and their validity.
        size: height and width in pixels.
    """
    depth = at_least_float32(maps.depth)
    inverse = torch.where(maps.valid, 1 / torch.where(maps.valid, depth, 1), 0)
    # Extend depths by one pixel: a finger may lie in the full-size mask but not in the copy's.
    weight, around = (F.avg_pool2d(values, 3, 1, 1) for values in (maps.valid.to(depth.dtype), inverse))
    inverse = torch.where(maps.valid, inverse, around / torch.where(weight > 0, weight, 1))
    weight = _resize((weight > 0).to(depth.dtype), size)
    inverse = _resize(inverse, size)
    return torch.where(inverse > 0, weight / torch.where(inverse > 0, inverse, 1), 0)


def _resize(maps: Float[Tensor, "B c H W"], size: Size) -> Float[Tensor, "B c h w"]:
    return F.interpolate(maps, size, mode="bilinear", antialias=True)


def _elements(batch: Batch, chosen: Tensor) -> Batch:
    """Select the input views of some elements, without targets and true depths."""
    alone = dataclasses.replace(batch, targets=None, depths=None, body_vertices=None, subjects=(), views=())
    return map_tensors(alone, lambda values: values[chosen])
