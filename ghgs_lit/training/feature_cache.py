"""Tokens of a frozen ViT on disk: of a photograph that is seen again they are read, not computed.

A file for each photograph, written whole, in a folder for each network and precision: several
processes may share it, and one that was interrupted goes on with what is there."""

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.files import write_atomically
from ghgs_lit.geometry.precision import rounds_products


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
