"""Disk cache for the patch tokens of a frozen ViT: an image that occurs again is not encoded again.

Each image has one file, written atomically, in a folder per network and precision. Several processes
may share the folder, and an interrupted run continues with the files that exist."""

import hashlib
import logging
import math
import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

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
    """No cache: all tokens are computed in each step."""

    group = "feature_cache"

    def needs(self, model: nn.Module, data: PhotographsDataModule) -> None:
        """Return None, as nothing is written."""

    def attach(self, model: nn.Module, data: PhotographsDataModule) -> None:
        """Leave the model unchanged."""


class DiskFeatureCache(Options):
    """Tokens of a frozen DINOv2 ViT are computed once for each training image and cached on disk."""

    group = "feature_cache"

    folder: PathText | None = None
    """Folder of the cache; null: the folder features in $GHGS_CACHE, or in ~/.cache/ghgs_lit."""

    def needs(self, model: nn.Module, data: PhotographsDataModule, network: str = "*") -> str:
        """Describe how much a training will write, and check that the disk has room for it.

        Args:
            model: as for :meth:`attach`; its weights are not read.
            data: as for :meth:`attach`.
            network: network whose tokens count as already written (:class:`FeatureCache`);
                ``*``: any.

        Returns:
            One line for the log.

        Raises:
            InputError: the encoder has no frozen ViT, the folder cannot be written to, or the disk has
                too little space.
        """
        vit = getattr(getattr(model.encoder, "aggregator", None), "patch_embed", None)
        fits = isinstance(vit, VisionTransformer) and not any(p.requires_grad for p in vit.parameters())
        expected = "none where encoder.vit is no dinov2 or learns (encoder.trainable)"
        require(fits, "feature_cache", expected, "disk")
        if data.augmentation.changes_photographs:
            return "feature_cache: off, since augmentation makes a new photograph in each step"
        count = sum(map(len, data.subjects("train").values()))
        patches = math.prod(-(-side // vit.patch_size) for side in data.dataset.size)  # rounded up: padding
        size = count * patches * 2 * vit.pos_embed.shape[-1]
        files = self._root.glob(f"{network}-*-float16/*/*.npy")
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
        """Make a model's encoder cache its tokens in training, and log how much space they take.

        Args:
            model: model whose encoder has its final weights, which are not trained.
            data: training data; if its augmentation changes images, nothing is cached.

        Raises:
            InputError: see :meth:`needs`.
        """
        text = self.needs(model, data)
        if not data.augmentation.changes_photographs:
            vit = model.encoder.aggregator.patch_embed
            heads = vit.blocks[0].attn.heads
            network = digest_of({**vit.state_dict(), f"heads {heads}": torch.zeros(0)})[:16]
            text = self.needs(model, data, network)
            vit.cache = FeatureCache(self._root, network)
        if rank_zero_only.rank == 0:
            log.info(text)


class FeatureCache:
    """Cache of patch tokens in float16, with the content of an image as key. Newly computed tokens are
    rounded to it, too, so that results do not depend on which tokens were cached.

    Args:
        folder: folder of the caches of all networks.
        network: name of the network, a digest of all its weights.
    """

    def __init__(self, folder: Path, network: str) -> None:
        self.folder = folder
        self.network = network
        #: Number of images whose tokens were read, and of those whose tokens were computed.
        self.read = self.computed = 0

    @torch.no_grad()
    def __call__(
        self, compute: Callable[[Tensor], Tensor], images: Float[Tensor, "n i H W"]
    ) -> Float[Tensor, "n p c"]:
        """Read the tokens of images, and compute those that are missing.

        Args:
            compute: function from images [m, i, H, W] to tokens [m, p, c].
            images: the network's input.

        Returns:
            Tokens [n, p, c] with the images' dtype and device.

        Raises:
            InputError: a token overflows float16.
            OSError: the disk is full.
        """
        paths = [self._path(image, images.device) for image in images.detach().cpu()]
        stored = [_map_file(path) for path in paths]
        lacking = [number for number, tokens in enumerate(stored) if tokens is None]
        if lacking:
            new = compute(images[lacking]).half()
            is_finite = bool(new.isfinite().all())
            require(is_finite, "feature_cache", "none where tokens are too large for float16", "disk")
            for number, tokens in zip(lacking, new.cpu(), strict=True):
                stored[number] = tokens.numpy()
                write_atomically(paths[number], partial(_write, stored[number]))
        self.computed += len(lacking)
        self.read += len(paths) - len(lacking)
        result = torch.empty(len(stored), *stored[0].shape, dtype=torch.float16, pin_memory=images.is_cuda)
        # Files of earlier versions hold the same bytes as int16.
        np.stack([tokens.view(np.float16) for tokens in stored], out=result.numpy())
        return result.to(images.device, non_blocking=True).to(images.dtype)

    def place(self, device: torch.device) -> Path:
        """Folder of this network and of the present precision of matrix products.

        Args:
            device: device that computes tokens.
        """
        kind = device.type
        rounding = "tf32" if rounds_products(kind) else "float32"
        if torch.is_autocast_enabled(kind):
            rounding = str(torch.get_autocast_dtype(kind)).removeprefix("torch.")
        return self.folder / f"{self.network}-{rounding}-float16"

    def _path(self, image: Tensor, device: torch.device) -> Path:
        """File of an image on the CPU, named by its dtype, shape and content."""
        digest = hashlib.sha256(f"{image.dtype} {tuple(image.shape)};".encode())
        digest.update(image.contiguous().numpy())
        name = digest.hexdigest()[:32]
        return self.place(device) / name[:2] / f"{name}.npy"


def _map_file(path: Path) -> np.ndarray | None:
    """Tokens [p, c] of a file, memory-mapped; None if it is missing or damaged."""
    try:
        return np.load(path, mmap_mode="r")
    except (FileNotFoundError, ValueError, EOFError):
        return None


def _write(values: np.ndarray, path: Path) -> None:
    with path.open("wb") as stream:  # given a path, NumPy would append .npy
        np.save(stream, values)
