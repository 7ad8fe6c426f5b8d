"""Tokens of a frozen encoder on disk: ablations and sweeps on the same photographs encode them once.

A file is addressed by the hash of all that its tokens hang on: weights and options of the encoder,
photographs, masks and intervals where they are read, what is kept of the tokens, precision and device.
Cameras do not take part: the encoder does not see them.
"""

import dataclasses
import hashlib
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from ghgs_lit.bounds.visual_hull import Interval
from ghgs_lit.errors import choice, require
from ghgs_lit.types import Tokens

if TYPE_CHECKING:
    from ghgs_lit.encoder.encoder import VGGTEncoder

#: Change when files of before must not be read any more.
LAYOUT = 1
PLACE = ("image", "row", "column")
DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}

#: Tensors of a file by name, and what the file says about them.
Stored = tuple[dict[str, Tensor], dict[str, str]]


class FeatureCache:
    """Gives the tokens of photographs, from ``directory`` where they are there, else encodes and keeps them.

    What comes back is always what the file holds, so that the first run and all others see the same. Files
    are written aside and renamed: runs may share a directory. A file that cannot be read is made anew.

    Args:
        directory: made where it does not exist.
        tokens: ``subject`` keeps patches with a pixel of the subject and ``ring`` patches around them (the
            dense heads see zeros elsewhere: a fifth of the size, not quite the same predictions);
            ``all`` keeps every patch: the same predictions as without a cache.
        ring: patches around the subject's that are kept.
        dtype: of the files: ``float32``, ``float16`` or ``bfloat16``. The tokens come back in the encoder's.
    """

    def __init__(self, directory: str | Path, tokens: str = "subject", ring: int = 1, dtype: str = "float32"):
        choice("feature_cache.tokens", tokens, ("subject", "all"))
        choice("feature_cache.dtype", dtype, tuple(DTYPES))
        require(isinstance(ring, int) and ring >= 0, "feature_cache.ring", "0 or more patches", ring)
        self.directory, self.tokens, self.ring, self.dtype = Path(directory), tokens, ring, dtype
        self.hits = self.made = self.written = 0
        self._versions: list = []
        self._hash = ""

    def __call__(
        self,
        encoder: "VGGTEncoder",
        images: Float[Tensor, "b v c H W"],
        masks: Bool[Tensor, "b v H W"],
        interval: Interval | None,
    ) -> Tokens:
        """As ``encoder.encode``; tokens carry no gradient."""
        trained = torch.is_grad_enabled() and any(p.requires_grad for p in encoder.parameters())
        require(not trained, "feature_cache", "a frozen encoder (encoder.trainable=none)", "one that learns")
        parts = []
        for b in range(len(images)):
            near_and_far = None if interval is None else tuple(x[b : b + 1] for x in interval)
            parts.append(self._element(encoder, images[b : b + 1], masks[b : b + 1], near_and_far))
        return parts[0] if len(parts) == 1 else _packed(parts)

    def report(self) -> str:
        """One line: what was found, what was made, and how much there is."""
        files = list(self.directory.glob("*/*.safetensors"))
        size = sum(file.stat().st_size for file in files)
        kept = "all tokens" if self.tokens == "all" else f"tokens of the subject and {self.ring} around it"
        return (
            f"feature cache {self.directory}: {self.hits} found, {self.made} made"
            f" ({self.written / 1e6:.1f} MB; {kept}, {self.dtype});"
            f" {len(files)} files, {size / 1e6:.1f} MB in all"
        )

    def _element(
        self, encoder: "VGGTEncoder", images: Tensor, masks: Tensor, interval: Interval | None
    ) -> Tokens:
        key = self._key(encoder, images, masks, interval)
        path = self.directory / key[:2] / f"{key}.safetensors"
        stored = _read(path)
        if stored is None:
            with torch.no_grad():
                tokens = encoder.encode(images, masks, interval)
            stored = self._stored(tokens, masks)
            self.written += _write(path, *stored)
            self.made += 1
        else:
            self.hits += 1
        return _tokens(*stored, images.device)

    def _stored(self, tokens: Tokens, masks: Tensor) -> Stored:
        """The tensors and the facts of a file."""
        tokens = tokens if self.tokens == "all" else _around_subject(tokens, masks, self.ring)
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

    def _key(self, encoder: "VGGTEncoder", images: Tensor, masks: Tensor, interval: Interval | None) -> str:
        device = images.device.type
        half = torch.is_autocast_enabled(device) and str(torch.get_autocast_dtype(device))
        kept = [self.tokens, self.ring if self.tokens == "subject" else 0, self.dtype]
        digest = hashlib.sha256(json.dumps([LAYOUT, self._fingerprint(encoder), kept, device, half]).encode())
        _add(digest, images)
        if encoder.mask_input or encoder.interval_input or self.tokens == "subject":
            _add(digest, masks)
        for bound in interval if encoder.interval_input and interval is not None else ():
            _add(digest, bound)
        return digest.hexdigest()

    def _fingerprint(self, encoder: "VGGTEncoder") -> str:
        """Hash of the encoder's options and weights, anew when a weight has changed."""
        # A change in place raises a tensor's version, another tensor lies elsewhere.
        state = encoder.state_dict(keep_vars=True)
        versions = [(t.data_ptr(), t._version, t.dtype) for t in state.values()]
        if versions != self._versions:
            digest = hashlib.sha256(json.dumps(encoder.options, sort_keys=True, default=list).encode())
            for name, tensor in sorted(state.items()):
                digest.update(name.encode())
                _add(digest, tensor)
            self._versions, self._hash = versions, digest.hexdigest()
        return self._hash


def attach_cache(model: nn.Module, options: Mapping[str, Any] | None) -> FeatureCache | None:
    """Let the encoder of ``model`` keep its tokens as the node ``feature_cache`` says; ``null``: not at all.

    Where every token takes part in the recalibration (``recalibration.tokens=all``) all are kept.
    """
    if not options or options["directory"] is None:
        return None
    tokens = "all" if model.recalibration.tokens == "all" else options["tokens"]
    model.encoder.cache = FeatureCache(**{**options, "tokens": tokens})
    return model.encoder.cache


def _add(digest, tensor: Tensor) -> None:
    digest.update(json.dumps([str(tensor.dtype), list(tensor.shape)]).encode())
    digest.update(tensor.detach().cpu().contiguous().view(torch.uint8).numpy())


def _around_subject(tokens: Tokens, masks: Tensor, ring: int) -> Tokens:
    """Tokens of patches with a pixel of the subject and of ``ring`` patches around them."""
    patches = F.max_pool2d(masks.flatten(0, 1)[:, None].float(), tokens.patch_size)
    kept = F.max_pool2d(patches, 2 * ring + 1, 1, ring)[:, 0].bool()
    index = kept[tokens.image, tokens.row, tokens.column]
    return dataclasses.replace(
        tokens,
        latent=tuple(layer[index] for layer in tokens.latent),
        semantic=tokens.semantic[index],
        **{name: getattr(tokens, name)[index] for name in PLACE},
    )


def _packed(parts: list[Tokens]) -> Tokens:
    """Tokens of one element each as those of a batch."""
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
    """What a file holds; ``None`` where there is none or it is broken."""
    try:
        with safe_open(path, framework="pt") as file:
            return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata())  # noqa: SIM118
    except FileNotFoundError:
        return None
    except (SafetensorError, OSError) as error:
        print(f"{path}: expected a whole file of features; {error}; it is made anew", flush=True)
        return None


def _write(path: Path, tensors: dict[str, Tensor], facts: dict[str, str]) -> int:
    """Write aside, then rename: who reads sees a whole file or none. Gives the bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, aside = tempfile.mkstemp(dir=path.parent, suffix=".aside")
    os.close(handle)
    try:
        save_file(tensors, aside, metadata=facts)
        size = os.path.getsize(aside)
        os.replace(aside, path)
    except BaseException:
        Path(aside).unlink(missing_ok=True)
        raise
    return size
