"""Which photographs' frozen tokens a training keeps on disk (:mod:`ghgs_lit.encoder.feature_cache`)."""

import logging
import math
import os
import shutil
from pathlib import Path
from typing import Literal

import torch
from lightning.pytorch.utilities import rank_zero_only
from torch import nn

from ghgs_lit.config.options import Options, PathText
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.encoder.feature_cache import FeatureCache
from ghgs_lit.encoder.vit import VisionTransformer
from ghgs_lit.errors import InputError, require
from ghgs_lit.weights.frozen import digest_of

log = logging.getLogger(__name__)

_DTYPES = {"float16": torch.float16, "bfloat16": torch.bfloat16}


class NoFeatureCache(Options):
    """All tokens are computed in each step."""

    group = "feature_cache"

    def attach(self, model: nn.Module, data: PhotographsDataModule) -> None:
        """Change nothing."""


class DiskFeatureCache(Options):
    """Tokens of a frozen DINOv2 ViT are computed once for each photograph of training, and kept on disk."""

    group = "feature_cache"

    folder: PathText | None = None
    """Where; null: features, in $GHGS_CACHE or ~/.cache/ghgs_lit"""
    dtype: Literal["float16", "bfloat16"] = "float16"
    """In which tokens are kept and used: float16 rounds to 11 bits, bfloat16 to 8"""

    def attach(self, model: nn.Module, data: PhotographsDataModule) -> None:
        """Let a model's encoder keep tokens in training, and say how much room they need.

        Args:
            model: whose encoder has its weights, and will not learn them.
            data: of the training; its augmentation must leave photographs as they are.

        Raises:
            InputError: the encoder has no frozen ViT, or the disk has no room.
        """
        vit = getattr(getattr(model.encoder, "aggregator", None), "patch_embed", None)
        fits = isinstance(vit, VisionTransformer) and not any(p.requires_grad for p in vit.parameters())
        expected = "none where encoder.vit is no dinov2 or learns (encoder.trainable)"
        require(fits, "feature_cache", expected, "disk")
        if data.augmentation.changes_photographs:
            _say("feature_cache: off, since augmentation makes a new photograph in each step")
            return
        folder = Path(self.folder or Path(os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit") / "features")
        heads = vit.blocks[0].attn.heads
        network = digest_of({**vit.state_dict(), f"heads {heads}": torch.zeros(0)})[:16]
        cache = FeatureCache(folder.expanduser(), network, _DTYPES[self.dtype])
        count = sum(map(len, data.subjects("train").values()))
        size = count * _bytes_of(vit, data.dataset.size)
        there = sum(path.stat().st_size for path in cache.folder.glob(f"{network}-*-{self.dtype}/*/*.npy"))
        sizes = f"{size / 1e9:.3g} GB, of which {there / 1e9:.3g} GB are there"
        _say(f"feature_cache: {cache.folder}: tokens of {count} photographs of training, {sizes}")
        cache.folder.mkdir(parents=True, exist_ok=True)
        free = shutil.disk_usage(cache.folder).free
        if free < size - there:
            expected = f"{(size - there) / 1e9:.3g} GB of room for tokens"
            raise InputError(
                f"feature_cache.folder: {cache.folder}: expected {expected}; found {free / 1e9:.3g}"
            )
        vit.cache = cache


def _bytes_of(vit: VisionTransformer, size: tuple[int, int]) -> int:
    """Bytes of the tokens of a photograph.

    Args:
        vit: has patches and channels.
        size: (height, width) in pixels; padded to whole patches.
    """
    return 2 * vit.pos_embed.shape[-1] * math.prod(-(-side // vit.patch_size) for side in size)


@rank_zero_only
def _say(text: str) -> None:
    log.info(text)
