"""Features of a frozen encoder on disk: ablations, sweeps and epochs encode the same photographs once.

A file's name is the hash of all that its content depends on: weights and options of what computes it, its
input, which patches are kept, precision and device. Cameras are not among them: no encoder sees them.
"""

import dataclasses
import json
from typing import Literal

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from ghgs_lit.config.options import Options, Path, Positive
from ghgs_lit.encoder.encoder import VGGTEncoder
from ghgs_lit.encoder.feature_files import FeatureFiles, Stored, hashed
from ghgs_lit.encoder.packing import KeptPatches
from ghgs_lit.errors import require
from ghgs_lit.types import DepthBounds, Tokens

#: Version of the files; raise it when older files must not be read any more.
LAYOUT = 1
PLACE = ("image", "row", "column")


class FeatureCacheOptions(Options):
    """Features of a frozen encoder on disk, for runs or epochs on the same photographs."""

    group = "feature_cache"
    directory: Path | None = None
    """null: no cache"""
    of: Literal["views", "photographs"] = "views"
    """views: tokens, a file for each ordered choice of views | photographs: what the patch encoder gives for
    each photograph, for any choice of views and blocks of the aggregator that learn"""
    dtype: Literal["float32", "float16", "bfloat16"] = "float32"
    """Precision of the files"""
    max_gb: Positive | None = 100
    """Size of all files, 10^9 bytes; beyond it the oldest are deleted; null: no limit"""

    def build(self) -> "FeatureCache | PhotographCache | None":
        """The cache; None without a directory."""
        if self.directory is None:
            return None
        kind = PhotographCache if self.of == "photographs" else FeatureCache
        return kind(self.directory, self.dtype, self.max_gb)


class FeatureCache(FeatureFiles):
    """Keeps the encoder's tokens, one file for each ordered choice of views; they come back in its dtype."""

    @property
    def content(self) -> str:
        return "tokens"

    def __call__(
        self,
        encoder: VGGTEncoder,
        images: Float[Tensor, "b v c H W"],
        masks: Bool[Tensor, "b v H W"],
        bounds: DepthBounds | None,
        kept: Bool[Tensor, "b v h w"],
    ) -> Tokens:
        """As ``encoder.encode``, without a gradient."""
        _require_frozen(encoder, "a frozen encoder (encoder.trainable=none)")
        parts = []
        for b in range(len(images)):
            one = slice(b, b + 1)
            ends = None if bounds is None else DepthBounds(bounds.near[one], bounds.far[one])
            inputs = images[one], masks[one], ends, kept[one]
            stored = self.stored(
                self._key(encoder, *inputs), lambda inputs=inputs: self._made(encoder, *inputs)
            )
            parts.append(_tokens(*stored, images.device))
        return parts[0] if len(parts) == 1 else _packed(parts)

    def _made(
        self, encoder: VGGTEncoder, images: Tensor, masks: Tensor, bounds: DepthBounds | None, kept: Tensor
    ) -> Stored:
        tokens = encoder.encode(images, masks, bounds, kept)
        layers = {f"latent_{i}": layer for i, layer in enumerate(tokens.latent)}
        tensors, facts = self.in_files_dtype(layers | {"semantic": tokens.semantic})
        places = {name: getattr(tokens, name).to("cpu", torch.int32).contiguous() for name in PLACE}
        return tensors | places, {
            **facts,
            "grid": json.dumps(tokens.grid),
            "patch_size": str(tokens.patch_size),
        }

    def _key(
        self, encoder: VGGTEncoder, images: Tensor, masks: Tensor, bounds: DepthBounds | None, kept: Tensor
    ) -> str:
        facts = [LAYOUT, encoder.options.facts, self.fingerprint(encoder), self.dtype, *_precision(images)]
        inputs = [images, kept]
        if encoder.mask_input or encoder.bounds_input or encoder.semantic is not None:
            inputs.append(masks)
        if encoder.bounds_input and bounds is not None:
            inputs += [bounds.near, bounds.far]
        return hashed(facts, inputs)


class PhotographCache(FeatureFiles):
    """Keeps the patch tokens of single photographs, that is, what enters the aggregator's first block.

    Any choice and order of views finds them again, and the aggregator may learn. Arguments as of
    :class:`FeatureFiles`.
    """

    @property
    def content(self) -> str:
        return "patch tokens of photographs"

    def __call__(
        self,
        encoder: VGGTEncoder,
        images: Float[Tensor, "b v c H W"],
        masks: Bool[Tensor, "b v H W"],
        bounds: DepthBounds | None,
        kept: Bool[Tensor, "b v h w"],
    ) -> Tokens:
        """As ``encoder.encode``, without a gradient of the patch tokens."""
        embed = encoder.aggregator.patch_embed
        _require_frozen(embed, "a frozen patch encoder (encoder.trainable=none or last_<n>)")
        about = [encoder.options.vit.model_dump(), encoder.patch_size]

        def patches(normalized: Float[Tensor, "n i H W"], _: KeptPatches) -> Float[Tensor, "N c"]:
            pairs = zip(normalized.split(1), kept.flatten(0, 1).split(1), strict=True)
            return torch.cat([self._photograph(embed, image, grid[None], about) for image, grid in pairs])

        return encoder.encode(images, masks, bounds, kept, patches)

    def _photograph(self, embed: nn.Module, image: Tensor, kept: Tensor, about: list) -> Tensor:
        facts = [LAYOUT, about, self.fingerprint(embed), self.dtype, *_precision(image)]

        def made() -> Stored:
            return self.in_files_dtype({"patches": embed(image, KeptPatches(kept, image.device))})

        tensors, dtypes = self.stored(hashed(facts, [image, kept]), made)
        return tensors["patches"].to(image.device, getattr(torch, dtypes["patches"]))


def _require_frozen(module: nn.Module, expected: str) -> None:
    trained = torch.is_grad_enabled() and any(p.requires_grad for p in module.parameters())
    require(not trained, "feature_cache", expected, "one that learns")


def _precision(images: Tensor) -> tuple[str, str | bool]:
    device = images.device.type
    return device, torch.is_autocast_enabled(device) and str(torch.get_autocast_dtype(device))


def _packed(parts: list[Tokens]) -> Tokens:
    """Tokens of one element each as the tokens of a batch."""
    views = parts[0].grid[1]
    return dataclasses.replace(
        parts[0],
        latent=tuple(torch.cat(layers) for layers in zip(*(p.latent for p in parts), strict=True)),
        semantic=torch.cat([p.semantic for p in parts]),
        image=torch.cat([p.image + b * views for b, p in enumerate(parts)]),
        row=torch.cat([p.row for p in parts]),
        column=torch.cat([p.column for p in parts]),
        grid=(len(parts), *parts[0].grid[1:]),
    )


def _tokens(tensors: dict[str, Tensor], facts: dict[str, str], device: torch.device) -> Tokens:
    values = {
        name: tensor.to(device, torch.int64 if name in PLACE else getattr(torch, facts[name]))
        for name, tensor in tensors.items()
    }
    latent = tuple(values[f"latent_{i}"] for i in range(len(values) - len(PLACE) - 1))
    place = {name: values[name] for name in PLACE}
    grid = tuple(json.loads(facts["grid"]))
    return Tokens(latent, values["semantic"], **place, grid=grid, patch_size=int(facts["patch_size"]))
