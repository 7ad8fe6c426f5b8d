"""Options of the encode stage."""

import re
from typing import TYPE_CHECKING, Literal

from pydantic import Field, model_validator

from ghgs_lit.config.options import Count, Options, Side, Text, Width
from ghgs_lit.encoder.semantic import SemanticOptions

if TYPE_CHECKING:
    from ghgs_lit.encoder.encoder import VGGTEncoder

#: Fields of each kind of patch embedding.
_FIELDS = {"conv": (), "stem": ("channels",), "dinov2": ("depth", "heads")}


class PatchOptions(Options):
    """Photographs to patch tokens."""

    group = "encoder.vit"
    kind: Literal["conv", "stem", "dinov2"]
    """conv, one convolution per patch | stem, a small convolutional stem | dinov2, a ViT with registers"""
    channels: Width | None = None
    """Of kind=stem: channels after the first convolution; doubled at each halving, up to the width"""
    depth: Count | None = Field(None, le=1024)
    """Of kind=dinov2: number of blocks"""
    heads: Width | None = None
    """Of kind=dinov2: attention heads of each block"""

    @model_validator(mode="after")
    def _fields_are_those_of_the_kind(self) -> "PatchOptions":
        for name in ("channels", "depth", "heads"):
            if name in _FIELDS[self.kind]:
                self.require(getattr(self, name) is not None, name, f"a number with kind={self.kind}")
            else:
                self.require(getattr(self, name) is None, name, f"null with kind={self.kind}")
        return self


class VGGTOptions(Options):
    """Photographs and masks to tokens, by VGGT of any size."""

    group = "encoder"
    width: Width
    """Channels of the aggregator's tokens; a multiple of 4 * heads"""
    heads: Width
    """Attention heads of its blocks"""
    depth: int = Field(ge=1, le=1024)
    """Pairs of a frame block and a global block"""
    layers: tuple[int, ...]
    """Pairs whose tokens are read out, ascending; the last pair is among them"""
    vit: PatchOptions
    """Photographs to patch tokens"""
    patch_size: int = Field(14, ge=1, le=1024)
    """Side of a patch, pixels"""
    image_size: Side = 518
    """Side of the square image whose patch positions a DINOv2 ViT stores, pixels; a multiple of patch_size"""
    mask_input: bool = False
    """true: the mask is a further input channel"""
    bounds_input: bool = False
    """true: near and far are two further input channels (not with bounds=none)"""
    semantic: SemanticOptions | None = None
    """null: the patch tokens are the semantic features | those of a branch of blocks over single views,
    which `ghgs pretext` trains and which does not learn afterwards"""
    layer_scale: float = 0.01
    """Initial LayerScale of the aggregator; 0.01 as published"""
    trainable: Text = "all"
    """all | none | last_<n>: the last n pairs of blocks"""
    checkpointing: bool = False
    """true: recompute activations in the backward pass, to save memory"""
    weights: Text | None = None
    """Name of the published weights that the semantic features learned from, or pretext; written by
    ghgs import and ghgs pretext, a note for tables only"""

    @model_validator(mode="after")
    def _parts_fit(self) -> "VGGTOptions":
        fits = self.width % (4 * self.heads) == 0
        self.require(fits, "width", "a multiple of 4 * heads (rows and columns rotate)")
        if self.vit.kind == "dinov2":
            heads, patch = self.vit.heads, self.patch_size
            self.require(self.width % heads == 0, "width", f"a multiple of vit.heads={heads}")
            self.require(self.image_size % patch == 0, "image_size", f"a multiple of {patch}")
        layers, last = list(self.layers), self.depth - 1
        fits = bool(layers) and sorted(set(layers)) == layers and layers[0] >= 0 and layers[-1] == last
        expected = f"ascending indices that end at the last of {self.depth} pairs of blocks"
        self.require(fits, "layers", expected)
        match = re.fullmatch(r"all|none|last_(\d+)", self.trainable)
        fits = match is not None and int(match[1] or 0) <= self.depth
        self.require(fits, "trainable", f"all, none or last_<n>, n up to {self.depth}")
        return self

    def build(self, tokens: str = "all", margin: int = 1) -> "VGGTEncoder":
        """The stage; arguments as of :class:`VGGTEncoder`."""
        from ghgs_lit.encoder.encoder import VGGTEncoder  # here: it imports these options

        return VGGTEncoder(self, tokens, margin)
