"""The encode stage: photographs and masks to tokens."""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ghgs_lit.encoder.aggregator import Aggregator, Pair
from ghgs_lit.encoder.packing import KeptPatches
from ghgs_lit.encoder.patch import ConvStem, PatchEmbed
from ghgs_lit.encoder.semantic import SemanticBranch
from ghgs_lit.encoder.vit import VisionTransformer
from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.masks import patches_around_subject, patches_in_window
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.relative_depth import BOUNDS_CHANNELS, relative_bounds
from ghgs_lit.types import DepthBounds, Tokens

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

#: Options of each kind of patch embedding (``encoder.vit``).
VIT_OPTIONS = {"conv": (), "stem": ("channels",), "dinov2": ("depth", "heads")}

#: Choices of ``encoder.tokens`` that leave patches out.
KEPT = {"window": patches_in_window, "subject": patches_around_subject}


class VGGTEncoder(nn.Module):
    """VGGT of any size: ``vggt_1b`` takes the published weights, smaller ones train from scratch.

    Args:
        width: of the aggregator's tokens.
        heads: of its attention.
        depth: pairs of a frame block and a global block.
        vit: ``{kind: conv}`` one convolution per patch; ``{kind: stem, channels}`` a small convolutional
            stem; ``{kind: dinov2, depth, heads}`` a DINOv2 ViT with registers.
        layers: indices of the pairs whose tokens are read out, ascending; the last pair must be among them.
        patch_size: side of a patch in pixels.
        registers: register tokens of each view.
        image_size: side of the square image whose patch positions a DINOv2 ViT stores, in pixels.
        mask_input: add the mask to the input channels.
        bounds_input: add two maps of the depth bounds (:func:`relative_bounds`) to the input channels.
        tokens: ``all``, or patches of the background leave before the first block: ``window`` keeps those of
            the smallest rectangle that holds the subject, ``subject`` those with a pixel of the subject. They
            keep their place in the photograph; a view with an empty mask keeps its special tokens only.
        margin: patches around them that stay, too.
        semantic: the semantic features: None, the patch tokens that enter the aggregator; or ``{width, depth,
            heads, channels, parts}`` of a :class:`SemanticBranch`, which does not learn here.
        layer_scale: initial value of the aggregator's LayerScale (0.01 as published).
        trainable: ``all``, ``none``, or ``last_<n>`` for the last n pairs of blocks.
        checkpointing: recompute activations in the backward pass instead of keeping them.
        weights: what the semantic features learned from, the name of published weights or ``pretext``, or
            None. A note for checkpoints and tables; nothing is loaded.
    """

    def __init__(
        self,
        width: int,
        heads: int,
        depth: int,
        vit: Mapping,
        layers: Sequence[int],
        patch_size: int = 14,
        registers: int = 4,
        image_size: int = 518,
        mask_input: bool = False,
        bounds_input: bool = False,
        tokens: str = "all",
        margin: int = 1,
        semantic: Mapping[str, int] | None = None,
        layer_scale: float = 0.01,
        trainable: str = "all",
        checkpointing: bool = False,
        weights: str | None = None,
    ):
        super().__init__()
        choice("encoder.tokens", tokens, ("all", *KEPT))
        require(margin >= 0, "encoder.margin", "0 or more patches", margin)
        #: All that the tokens depend on, the weights and the choice of tokens apart.
        self.options: dict[str, Any] = {
            "width": width,
            "heads": heads,
            "depth": depth,
            "vit": dict(vit),
            "layers": list(layers),
            "patch_size": patch_size,
            "registers": registers,
            "mask_input": mask_input,
            "bounds_input": bounds_input,
        }
        if semantic is not None:
            self.options["semantic"] = dict(semantic)
        self.tokens, self.margin = tokens, margin
        self.weights = weights
        self.patch_size, self.mask_input, self.bounds_input = patch_size, mask_input, bounds_input
        self.dim_latent = 2 * width
        mean, std = (*IMAGENET_MEAN, *[0.5] * mask_input), (*IMAGENET_STD, *[0.5] * mask_input)
        channels = len(mean) + BOUNDS_CHANNELS * bounds_input
        # No part of a checkpoint, so they need storage even in a model that is built on the meta device.
        for name, values in (("mean", mean), ("std", std)):
            constant = torch.tensor(values, device="cpu").view(-1, 1, 1)
            self.register_buffer(name, constant, persistent=False)
        patch_embed = _patch_embedding(vit, channels, width, patch_size, image_size, registers, checkpointing)
        self.aggregator = Aggregator(
            patch_embed, patch_size, width, heads, depth, registers, layers, layer_scale, checkpointing
        )
        self._set_trainable(trainable, depth)
        self.semantic = None
        if semantic is not None:
            self.semantic = SemanticBranch.of(semantic, patch_size).requires_grad_(False)
        self.dim_semantic = width if self.semantic is None else self.semantic.parts

    def _set_trainable(self, trainable: str, depth: int) -> None:
        if trainable == "all":
            return
        digits = trainable.removeprefix("last_")
        count = 0 if trainable == "none" else int(digits) if digits.isdecimal() else -1
        require(
            0 <= count <= depth, "encoder.trainable", f"all, none or last_<n>, n up to {depth}", trainable
        )
        self.requires_grad_(False)
        for blocks in (self.aggregator.frame_blocks, self.aggregator.global_blocks):
            blocks[depth - count :].requires_grad_(True)

    def forward(
        self,
        images: Float[Tensor, "b v c H W"],
        masks: Bool[Tensor, "..."],
        bounds: DepthBounds | None = None,
        cache: Callable[..., Tokens] | None = None,
        kept: Bool[Tensor, "b v h w"] | None = None,
    ) -> Tokens:
        """Tokens of all views: of all patches, or of those that are kept.

        Args:
            images: [B, V, 3, H, W], RGB in [0, 1], sides divisible by the patch size.
            masks: [B, V, H, W]; read with ``mask_input``, ``bounds_input`` or ``semantic``, and where
                ``tokens`` is not ``all``.
            bounds: read with ``bounds_input``.
            cache: to look features up in (:mod:`ghgs_lit.encoder.cache`); None: compute them.
            kept: which patches take part; None: those of :meth:`keeps`.
        """
        self._check(images, masks)
        kept = self.keeps(masks) if kept is None else kept
        encode = self.encode if cache is None else functools.partial(cache, self)
        return encode(images, masks, bounds, kept)

    def encode(
        self,
        images: Float[Tensor, "b v c H W"],
        masks: Bool[Tensor, "..."],
        bounds: DepthBounds | None,
        kept: Bool[Tensor, "b v h w"],
        embed: Callable[[Tensor, KeptPatches], Tensor] | None = None,
    ) -> Tokens:
        """Compute the tokens of the kept patches of all views; arguments as in :meth:`forward`.

        ``embed`` takes the place of the patch embedding.
        """
        chosen, kept = kept, KeptPatches(kept, images.device)
        pairs, patches = self.aggregator(self._normalized(images, masks, bounds), kept, embed)
        return Tokens(
            latent=tuple(_joined(pairs, kept, self.aggregator.special)),
            semantic=patches.detach() if self.semantic is None else self.semantic(images, masks, chosen),
            image=kept.image,
            row=kept.row,
            column=kept.column,
            grid=kept.grid,
            patch_size=self.patch_size,
        )

    def keeps(self, masks: Bool[Tensor, "b v H W"]) -> Bool[Tensor, "b v h w"]:
        """Which patches ``tokens`` and ``margin`` let take part; on the CPU where the masks are not read."""
        if self.tokens in KEPT:
            return KEPT[self.tokens](masks, self.patch_size, self.margin)
        b, v, height, width = masks.shape
        grid = (b, v, height // self.patch_size, width // self.patch_size)
        return torch.ones(grid, dtype=torch.bool, device="cpu")

    def _check(self, images: Tensor, masks: Tensor) -> None:
        b, v, channels, height, width = images.shape
        require(channels == 3, "images", "3 channels", channels)
        expected = f"height and width divisible by the patch size {self.patch_size}"
        divisible = height % self.patch_size == width % self.patch_size == 0 < min(height, width)
        require(divisible, "images", expected, f"{height} x {width}")
        require(masks.shape == (b, v, height, width), "masks", str((b, v, height, width)), tuple(masks.shape))

    def _normalized(self, images: Tensor, masks: Tensor, bounds: DepthBounds | None) -> Tensor:
        """Input channels with zero mean and unit standard deviation, in the precision of the weights."""
        x = at_least_float32(images)
        if self.mask_input:
            x = torch.cat((x, masks.to(x.dtype)[:, :, None]), dim=2)
        x = (x - self.mean) / self.std
        if self.bounds_input:
            require(bounds is not None, "encoder.bounds_input", "depths that are bounded", "no bounds")
            x = torch.cat((x, relative_bounds(bounds, masks).to(x.dtype)), dim=2)
        return x.to(self.aggregator.camera_token.dtype)


def _joined(pairs: list[Pair], kept: KeptPatches, special: int) -> Iterator[Float[Tensor, "N C"]]:
    """Patch tokens of frame and global block, concatenated; empties ``pairs`` to free memory."""
    while pairs:
        yield torch.cat([kept.take(tokens, special) for tokens in pairs.pop(0)], dim=-1)


def _patch_embedding(
    vit: Mapping,
    in_channels: int,
    width: int,
    patch_size: int,
    image_size: int,
    registers: int,
    checkpointing: bool,
) -> nn.Module:
    """Build what ``encoder.vit`` describes."""
    kind, options = vit.get("kind"), {key: value for key, value in vit.items() if key != "kind"}
    choice("encoder.vit.kind", kind, tuple(VIT_OPTIONS))
    expected = ", ".join(VIT_OPTIONS[kind]) or "none"
    require(
        set(options) == set(VIT_OPTIONS[kind]),
        f"encoder.vit ({kind})",
        f"options: {expected}",
        sorted(options),
    )
    if kind == "conv":
        return PatchEmbed(in_channels, width, patch_size)
    if kind == "stem":
        return ConvStem(in_channels, width, patch_size, **options)
    return VisionTransformer(
        in_channels,
        width,
        patch_size=patch_size,
        image_size=image_size,
        registers=registers,
        checkpointing=checkpointing,
        **options,
    )
