"""Tokens of a frozen ViT on disk: of a photograph that is seen again they are read, not computed.

A file for each photograph, written whole, in a folder for each network and precision: several
processes may share it, and one that was interrupted goes on with what is there."""

import hashlib
import logging
import math
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor, nn

from ghgs_lit.config.options import Options, PathText
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.errors import require
from ghgs_lit.files import require_writable, write_atomically
from ghgs_lit.geometry.precision import rounds_products
from ghgs_lit.method.encoder.vit import VisionTransformer
from ghgs_lit.weights.frozen import digest_of

log = logging.getLogger(__name__)


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

    def needs(self, model: nn.Module, data: PhotographsDataModule, network: str = "*") -> str:
        """How much a training will write, in words.

        Args:
            model: as of :meth:`attach`; its weights are not read.
            data: as of :meth:`attach`.
            network: name of the network whose tokens count as written; ``*``: any.

        Raises:
            InputError: the encoder has no frozen ViT, the folder cannot be written,
                or the disk has no room.
        """
        vit = getattr(getattr(model.encoder, "aggregator", None), "patch_embed", None)
        fits = isinstance(vit, VisionTransformer) and not any(p.requires_grad for p in vit.parameters())
        expected = "none where encoder.vit is no dinov2 or learns (encoder.trainable)"
        require(fits, "feature_cache", expected, "disk")
        if data.augmentation.changes_photographs:
            return "feature_cache: off, since augmentation makes a new photograph in each step"
        count = sum(map(len, data.subjects("train").values()))
        patches = math.prod(-(-side // vit.patch_size) for side in data.dataset.size)  # some are padded
        size = count * patches * 2 * vit.pos_embed.shape[-1]
        files = self._root.glob(f"{network}-*-{self.dtype}/*/*.npy")
        there = sum(path.stat().st_size for path in files)
        key = f"feature_cache.folder: {self._root}"
        free = shutil.disk_usage(require_writable(self._root.absolute(), key, "tokens")).free
        room = f"{(size - there) / 1e9:.3g} GB of room for tokens"
        require(free >= size - there, key, room, f"{free / 1e9:.3g} GB")
        return f"feature_cache: {self._root}: tokens of {count} photographs of training, {size / 1e9:.3g} GB"

    @property
    def _root(self) -> Path:
        shared = Path(os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit")
        return Path(self.folder or shared / "features").expanduser()

    def attach(self, model: nn.Module, data: PhotographsDataModule) -> None:
        """Let a model's encoder keep tokens in training, and log how much room they need.

        Args:
            model: whose encoder has its weights, and will not learn them.
            data: of the training; where its augmentation changes photographs, nothing is kept.

        Raises:
            InputError: as :meth:`needs`.
        """
        text = self.needs(model, data)
        if not data.augmentation.changes_photographs:
            vit = model.encoder.aggregator.patch_embed
            heads = vit.blocks[0].attn.heads
            network = digest_of({**vit.state_dict(), f"heads {heads}": torch.zeros(0)})[:16]
            text = self.needs(model, data, network)
            vit.cache = FeatureCache(self._root, network, getattr(torch, self.dtype))
        if rank_zero_only.rank == 0:
            log.info(text)


class FeatureCache:
    """Patch tokens by the content of a photograph.

    Args:
        folder: of all networks.
        network: name of one, which depends on all of its weights.
        dtype: float16 or bfloat16, in which tokens are kept. A photograph's are rounded to it when
            they are computed, too, so that a training does not depend on which it found.
    """

    def __init__(self, folder: Path, network: str, dtype: torch.dtype) -> None:
        self.folder = folder
        self.network = network
        self.dtype = dtype
        #: Photographs whose tokens were read, and those whose tokens were computed.
        self.read = self.computed = 0

    @torch.no_grad()
    def __call__(
        self, compute: Callable[[Tensor], Tensor], images: Float[Tensor, "n i H W"]
    ) -> Float[Tensor, "n p c"]:
        """Tokens of all patches.

        Args:
            compute: images [m, i, H, W] to tokens [m, p, c].
            images: as the network sees them.

        Returns:
            Tokens [n, p, c] of the images' dtype and device.

        Raises:
            InputError: a token is too large for ``dtype``.
            OSError: the disk is full.
        """
        paths = [self._path(image, images.device) for image in images.detach().cpu()]
        stored = [_mapped(path) for path in paths]
        lacking = [number for number, tokens in enumerate(stored) if tokens is None]
        if lacking:
            new = compute(images[lacking]).to(self.dtype)
            expected = f"tokens that {str(self.dtype).removeprefix('torch.')} can hold"
            require(bool(new.isfinite().all()), "feature_cache.dtype", expected, "larger ones")
            for number, tokens in zip(lacking, new.cpu(), strict=True):
                stored[number] = tokens.view(torch.int16).numpy()  # NumPy has no bfloat16
                write_atomically(paths[number], partial(_write, stored[number]))
        self.computed += len(lacking)
        self.read += len(paths) - len(lacking)
        result = torch.empty(len(stored), *stored[0].shape, dtype=torch.int16, pin_memory=images.is_cuda)
        np.stack(stored, out=result.numpy())
        return result.view(self.dtype).to(images.device, non_blocking=True).to(images.dtype)

    def place(self, device: torch.device) -> Path:
        """The folder of this network, as its products round on a device now.

        Args:
            device: that computes tokens.
        """
        kind = device.type
        rounding = "tf32" if rounds_products(kind) else "float32"
        if torch.is_autocast_enabled(kind):
            rounding = str(torch.get_autocast_dtype(kind)).removeprefix("torch.")
        return self.folder / f"{self.network}-{rounding}-{str(self.dtype).removeprefix('torch.')}"

    def _path(self, image: Tensor, device: torch.device) -> Path:
        """The file of an image, by its content and shape.

        Args:
            image: on the CPU.
            device: that computes its tokens.
        """
        digest = hashlib.sha256(f"{image.dtype} {tuple(image.shape)};".encode())
        digest.update(image.contiguous().numpy())
        name = digest.hexdigest()[:32]
        return self.place(device) / name[:2] / f"{name}.npy"


def _mapped(path: Path) -> np.ndarray | None:
    """Tokens [p, c] of a file, as integers of 16 bits; None: there is none, or it is damaged."""
    try:
        return np.load(path, mmap_mode="r")
    except (FileNotFoundError, ValueError, EOFError):
        return None


def _write(values: np.ndarray, path: Path) -> None:
    with path.open("wb") as stream:  # NumPy would add a suffix to a name
        np.save(stream, values)
