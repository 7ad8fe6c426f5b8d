"""Which photographs' frozen tokens a training keeps on disk
(:mod:`ghgs_lit.training.feature_cache`)."""

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
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import require_writable
from ghgs_lit.method.encoder.vit import VisionTransformer
from ghgs_lit.training.feature_cache import FeatureCache
from ghgs_lit.weights.frozen import digest_of

log = logging.getLogger(__name__)

_DTYPES = {"float16": torch.float16, "bfloat16": torch.bfloat16}


class NoFeatureCache(Options):
    """All tokens are computed in each step."""

    group = "feature_cache"

    def needs(self, model: nn.Module, data: PhotographsDataModule) -> None:
        """Nothing."""

    def attach(self, model: nn.Module, data: PhotographsDataModule) -> None:
        """Change nothing."""


class DiskFeatureCache(Options):
    """Tokens of a frozen DINOv2 ViT are computed once for each photograph of training,
    and kept on disk."""

    group = "feature_cache"

    folder: PathText | None = None
    """Where; null: features, in $GHGS_CACHE or ~/.cache/ghgs_lit"""
    dtype: Literal["float16", "bfloat16"] = "float16"
    """In which tokens are kept and used: float16 rounds to 11 bits, bfloat16 to 8"""

    @property
    def _root(self) -> Path:
        shared = Path(os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit")
        return Path(self.folder or shared / "features").expanduser()

    def needs(self, model: nn.Module, data: PhotographsDataModule) -> str:
        """How much a training will write, in words.

        Args:
            model: as of :meth:`attach`; its weights are not read.
            data: as of :meth:`attach`.

        Raises:
            InputError: the encoder has no frozen ViT, the folder cannot be written,
                or the disk has no room.
        """
        vit = _frozen_vit(model)
        if data.augmentation.changes_photographs:
            return "feature_cache: off, since augmentation makes a new photograph in each step"
        count, size = _amount(vit, data)
        self._require_room(size, "*")
        return f"feature_cache: {self._root}: tokens of {count} photographs of training, {size / 1e9:.3g} GB"

    def attach(self, model: nn.Module, data: PhotographsDataModule) -> None:
        """Let a model's encoder keep tokens in training, and say how much room they need.

        Args:
            model: whose encoder has its weights, and will not learn them.
            data: of the training; its augmentation must leave photographs as they are.

        Raises:
            InputError: the encoder has no frozen ViT, or the disk has no room.
        """
        text = self.needs(model, data)
        vit = _frozen_vit(model)
        if data.augmentation.changes_photographs:
            return _say(text)
        heads = vit.blocks[0].attn.heads
        network = digest_of({**vit.state_dict(), f"heads {heads}": torch.zeros(0)})[:16]
        there = self._require_room(_amount(vit, data)[1], network)
        _say(f"{text}, of which {there / 1e9:.3g} GB are there")
        vit.cache = FeatureCache(self._root, network, _DTYPES[self.dtype])

    def _require_room(self, size: int, network: str) -> int:
        """Refuse a folder that cannot be written, or whose disk has no room for the tokens.

        Args:
            size: bytes of all tokens.
            network: name of the network whose tokens count as written; ``*``: any.

        Returns:
            Bytes of the tokens that are there.

        Raises:
            InputError: names the folder.
        """
        key = f"feature_cache.folder: {self._root}"
        place = require_writable(self._root.absolute(), key, "tokens")
        files = self._root.glob(f"{network}-*-{self.dtype}/*/*.npy")
        there = sum(path.stat().st_size for path in files)
        free = shutil.disk_usage(place).free
        if free < size - there:
            room = f"expected {(size - there) / 1e9:.3g} GB of room for tokens; found {free / 1e9:.3g}"
            raise InputError(f"{key}: {room}")
        return there


def _frozen_vit(model: nn.Module) -> VisionTransformer:
    """The ViT of a model's encoder; InputError: there is none, or it learns."""
    vit = getattr(getattr(model.encoder, "aggregator", None), "patch_embed", None)
    fits = isinstance(vit, VisionTransformer) and not any(p.requires_grad for p in vit.parameters())
    expected = "none where encoder.vit is no dinov2 or learns (encoder.trainable)"
    require(fits, "feature_cache", expected, "disk")
    return vit


def _amount(vit: VisionTransformer, data: PhotographsDataModule) -> tuple[int, int]:
    """Number of photographs of training, and bytes of their tokens;
    the last patches may be padded."""
    count = sum(map(len, data.subjects("train").values()))
    patches = math.prod(-(-side // vit.patch_size) for side in data.dataset.size)
    return count, count * patches * 2 * vit.pos_embed.shape[-1]


@rank_zero_only
def _say(text: str) -> None:
    log.info(text)
