"""Tokens of a frozen encoder on disk: ablations and sweeps on the same photographs encode them once.

A file's name is the hash of all that its tokens depend on: weights and options of the encoder, photographs,
masks and bounds where they are read, which tokens are kept, precision and device. Cameras are not among
them: the encoder does not see them.
"""

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from ghgs_lit.encoder.encoder import VGGTEncoder
from ghgs_lit.errors import choice, require
from ghgs_lit.files import write_atomically
from ghgs_lit.geometry.masks import patches_around_subject
from ghgs_lit.types import DepthBounds, Tokens

#: Version of the files; raise it when older files must not be read any more.
LAYOUT = 1
PLACE = ("image", "row", "column")
DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}

#: Tensors of a file by name, and its metadata.
Stored = tuple[dict[str, Tensor], dict[str, str]]


class FeatureCache:
    """Reads the tokens of photographs from ``directory``, or computes them and writes them there.

    What comes back is always what the file holds, so that the first run and all others see the same. Files
    are written atomically: runs may share a directory. A file that cannot be read is written again.

    Args:
        directory: created where it does not exist.
        tokens: ``subject`` keeps patches with a pixel of the subject and ``margin`` patches around them (the
            dense heads see zeros elsewhere: a fifth of the size, slightly different predictions);
            ``all`` keeps every patch: the same predictions as without a cache.
        margin: patches around the subject that are kept.
        dtype: of the files: ``float32``, ``float16`` or ``bfloat16``. The tokens come back in the encoder's.
        max_gb: size of all files, 10^9 bytes; beyond it the oldest are deleted. None: no limit.
    """

    def __init__(
        self,
        directory: str | Path,
        tokens: str = "subject",
        margin: int = 1,
        dtype: str = "float32",
        max_gb: float | int | None = None,
    ):
        choice("feature_cache.tokens", tokens, ("subject", "all"))
        choice("feature_cache.dtype", dtype, tuple(DTYPES))
        require(isinstance(margin, int) and margin >= 0, "feature_cache.margin", "0 or more patches", margin)
        valid = max_gb is None or (isinstance(max_gb, (int, float)) and max_gb > 0)
        require(valid, "feature_cache.max_gb", "null or a positive number of gigabytes", max_gb)
        self.directory, self.tokens, self.margin, self.dtype = Path(directory), tokens, margin, dtype
        self.limit = None if max_gb is None else int(1e9 * max_gb)
        self.hits = self.made = self.written = self.deleted = 0
        # Bytes of all files: other runs may write too, so it is counted again before anything is deleted.
        self._bytes = 0 if self.limit is None else sum(_size(file) for file in self._files())
        self._versions: list = []
        self._hash = ""

    def __call__(
        self,
        encoder: VGGTEncoder,
        images: Float[Tensor, "b v c H W"],
        masks: Bool[Tensor, "b v H W"],
        bounds: DepthBounds | None,
        kept: Bool[Tensor, "b v h w"],
    ) -> Tokens:
        """As ``encoder.encode``, without a gradient."""
        trained = torch.is_grad_enabled() and any(p.requires_grad for p in encoder.parameters())
        require(not trained, "feature_cache", "a frozen encoder (encoder.trainable=none)", "one that learns")
        parts = []
        for b in range(len(images)):
            one = slice(b, b + 1)
            own = None if bounds is None else DepthBounds(bounds.near[one], bounds.far[one])
            parts.append(self._element(encoder, images[one], masks[one], own, kept[one]))
        return parts[0] if len(parts) == 1 else _packed(parts)

    def report(self) -> str:
        """One line: how many samples were found and encoded, and the size of the cache."""
        files = self._files()
        size = sum(map(_size, files))
        kept = "all tokens" if self.tokens == "all" else f"tokens of the subject and {self.margin} around it"
        return (
            f"feature cache {self.directory}: {self.hits} found, {self.made} made"
            f" ({self.written / 1e6:.1f} MB; {kept}, {self.dtype});"
            f" {len(files)} files, {size / 1e6:.1f} MB in all"
            + (f"; {self.deleted} old ones deleted (feature_cache.max_gb)" if self.deleted else "")
        )

    def _files(self) -> list[Path]:
        return list(self.directory.glob("*/*.safetensors"))

    def _delete_oldest(self, newest: Path) -> None:
        """Delete the files that were written first, until a tenth of the limit is free; keep ``newest``."""
        files = sorted((file for file in self._files() if file != newest), key=_written)
        self._bytes = _size(newest) + sum(map(_size, files))
        for file in files:
            if self._bytes <= 0.9 * self.limit:
                break
            self._bytes -= _size(file)
            file.unlink(missing_ok=True)
            self.deleted += 1

    def _element(
        self, encoder: VGGTEncoder, images: Tensor, masks: Tensor, bounds: DepthBounds | None, kept: Tensor
    ) -> Tokens:
        key = self._key(encoder, images, masks, bounds, kept)
        path = self.directory / key[:2] / f"{key}.safetensors"
        stored = _read(path)
        if stored is None:
            with torch.no_grad():
                tokens = encoder.encode(images, masks, bounds, kept)
            stored = self._stored(tokens, masks)
            size = _write(path, *stored)
            self.written += size
            self._bytes += size
            self.made += 1
            if self.limit is not None and self._bytes > self.limit:
                self._delete_oldest(path)
        else:
            self.hits += 1
        return _tokens(*stored, images.device)

    def _stored(self, tokens: Tokens, masks: Tensor) -> Stored:
        """The tensors and the metadata of a file."""
        tokens = tokens if self.tokens == "all" else _around_subject(tokens, masks, self.margin)
        values = {f"latent_{i}": layer for i, layer in enumerate(tokens.latent)} | {
            "semantic": tokens.semantic
        }
        facts = {name: str(value.dtype).removeprefix("torch.") for name, value in values.items()}
        tensors = {name: value.to(DTYPES[self.dtype]) for name, value in values.items()}
        tensors |= {name: getattr(tokens, name).to(torch.int32) for name in PLACE}
        return {name: tensor.cpu().contiguous() for name, tensor in tensors.items()}, {
            **facts,
            "grid": json.dumps(tokens.grid),
            "patch_size": str(tokens.patch_size),
        }

    def _key(
        self, encoder: VGGTEncoder, images: Tensor, masks: Tensor, bounds: DepthBounds | None, kept: Tensor
    ) -> str:
        device = images.device.type
        half = torch.is_autocast_enabled(device) and str(torch.get_autocast_dtype(device))
        stored = [self.tokens, self.margin if self.tokens == "subject" else 0, self.dtype]
        facts = [LAYOUT, encoder.options, self._fingerprint(encoder), stored, device, half]
        digest = hashlib.sha256(json.dumps(facts, sort_keys=True, default=list).encode())
        _add(digest, images)
        _add(digest, kept)
        if encoder.mask_input or encoder.bounds_input or self.tokens == "subject":
            _add(digest, masks)
        if encoder.bounds_input and bounds is not None:
            _add(digest, bounds.near)
            _add(digest, bounds.far)
        return digest.hexdigest()

    def _fingerprint(self, encoder: VGGTEncoder) -> str:
        """Hash of the encoder's weights, computed again when one has changed."""
        # A change in place raises a tensor's version; another tensor has another address.
        state = encoder.state_dict(keep_vars=True)
        versions = [(t.data_ptr(), t._version, t.dtype) for t in state.values()]
        if versions != self._versions:
            digest = hashlib.sha256()
            for name, tensor in sorted(state.items()):
                digest.update(name.encode())
                _add(digest, tensor)
            self._versions, self._hash = versions, digest.hexdigest()
        return self._hash


def open_cache(options: Mapping[str, Any] | None, recalibrated: str) -> FeatureCache | None:
    """The cache that the configuration describes.

    Args:
        options: the node ``feature_cache``; without a ``directory`` there is no cache.
        recalibrated: ``recalibration.tokens`` of the model; with ``all``, all tokens are kept.
    """
    if not options or options["directory"] is None:
        return None
    return FeatureCache(**{**options, "tokens": "all" if recalibrated == "all" else options["tokens"]})


def _size(file: Path) -> int:
    """Bytes of a file; 0 where another run has deleted it."""
    try:
        return file.stat().st_size
    except FileNotFoundError:
        return 0


def _written(file: Path) -> float:
    """When a file was written; 0 where another run has deleted it."""
    try:
        return file.stat().st_mtime
    except FileNotFoundError:
        return 0.0


def _add(digest, tensor: Tensor) -> None:
    digest.update(json.dumps([str(tensor.dtype), list(tensor.shape)]).encode())
    digest.update(tensor.detach().cpu().contiguous().view(torch.uint8).numpy())


def _around_subject(tokens: Tokens, masks: Tensor, margin: int) -> Tokens:
    """Tokens of patches with a pixel of the subject and of ``margin`` patches around them."""
    kept = patches_around_subject(masks, tokens.patch_size, margin).flatten(0, 1)
    return tokens.select(kept[tokens.image, tokens.row, tokens.column])


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


def _read(path: Path) -> Stored | None:
    """The content of a file; None where there is none or it is broken."""
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata())  # noqa: SIM118
    except FileNotFoundError:
        return None
    except (SafetensorError, OSError) as error:
        print(f"{path}: expected a whole file of features; {error}; it is written again", flush=True)
        return None


def _write(path: Path, tensors: dict[str, Tensor], facts: dict[str, str]) -> int:
    """Write a file; returns its bytes."""
    write_atomically(path, lambda temporary: save_file(tensors, temporary, metadata=facts))
    return path.stat().st_size
