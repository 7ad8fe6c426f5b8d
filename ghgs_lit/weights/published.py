"""Import of published weights to a checkpoint: every tensor must be used or listed as ignored."""

import hashlib
import re
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ghgs_lit.errors import InputError, import_optional, require
from ghgs_lit.weights.checkpoint import describe, require_shape, shape_of, write_checkpoint
from ghgs_lit.weights.reading import open_file

FILE = "model.safetensors"

#: Our prefixes by those of facebook/VGGT-1B. A file of the aggregator alone lacks ``aggregator.``.
VGGT = {
    "aggregator.": "encoder.aggregator.",
    "camera_token": "encoder.aggregator.camera_token",
    "register_token": "encoder.aggregator.register_token",
    "patch_embed.": "encoder.aggregator.patch_embed.",
    "frame_blocks.": "encoder.aggregator.frame_blocks.",
    "global_blocks.": "encoder.aggregator.global_blocks.",
}

#: Parts of VGGT-1B that the method does not use: 62, 62, 69 and 394 tensors.
VGGT_IGNORED = ("depth_head.", "point_head.", "camera_head.", "track_head.")

#: Our prefixes by those of the authors' checkpoint, whose tensors are under the key ``network``.
RELEASE = {
    "pos_head.": "depth_head.dpt.",
    "blk.": "recalibration.block.",
    "decoder.": "gaussian_head.decoder.",
    "offset_header.": "gaussian_head.offset_header.",
    "scale_header.": "gaussian_head.scale_header.",
    "rot_header.": "gaussian_head.rot_header.",
    "opacity_header.": "gaussian_head.opacity_header.",
}
RELEASE_ENTRY = "network"

UNPUBLISHED = ".guide."  #: Part of the names of tensors that only this package's variants have


def to_ours(name: str, table: Mapping[str, str]) -> str | None:
    """Convert a published name of a tensor to ours; None if ``table`` (our prefixes by published ones)
    has no match."""
    for published, ours in table.items():
        if name.startswith(published):
            return ours + name.removeprefix(published)
    return None


def to_published(name: str, table: Mapping[str, str]) -> str | None:
    """Convert our name of a tensor to the published one; None if there is none. Inverse of
    :func:`to_ours`."""
    if UNPUBLISHED in name:
        return None
    for published, ours in table.items():
        if name.startswith(ours):
            return published + name.removeprefix(ours)
    return None


def is_repository(name: str) -> bool:
    """Whether a source of weights looks like ``owner/repository``: neither an existing file nor with the
    suffix of a weight file."""
    return (
        re.fullmatch(r"[\w.-]+/[\w.-]+", name) is not None
        and Path(name).suffix not in (".pt", ".pth", ".bin", ".ckpt", ".safetensors")
        and not Path(name).exists()
    )


def fetch(repository: str) -> tuple[str, Path, str]:
    """Get the weights of a repository from the local cache or the Hugging Face hub.

    Args:
        repository: ``owner/repository``.

    Returns:
        Name of the repository, path of the file and its SHA-256.

    Raises:
        InputError: the package huggingface_hub, the network or the repository is not available, or
            the checksum differs from the published one.
    """
    hub = import_optional("huggingface_hub", "hub", repository)
    cached = hub.try_to_load_from_cache(repository, FILE)
    if not isinstance(cached, str):
        try:
            cached = hub.hf_hub_download(repository, FILE)
        except Exception as error:
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            raise InputError(
                f"{repository}: expected the hub or a cached copy; found: {reason}. Download"
                f" {hub.hf_hub_url(repository, FILE)} by hand and set vggt=<that file>"
            ) from error
    path = Path(cached)
    # The cache names files by their published checksums.
    digest = sha256(path)
    published = path.resolve().name
    is_whole = digest == published or not re.fullmatch(r"[0-9a-f]{64}", published)
    require(is_whole, str(path.resolve()), f"SHA-256 {published}", f"{digest}: a broken download: delete it")
    return repository, path, digest


def sha256(path: Path) -> str:
    """SHA-256 of a file in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def published_tensors(path: Path, entry: str | None = None) -> dict[str, Tensor]:
    """All tensors of a file of published weights by published names, memory-mapped.

    Args:
        path: path of the file.
        entry: key under which the file holds its tensors, if any.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: the file holds something else, or lacks ``entry``.
    """
    content = open_file(path)
    if entry is not None:
        nested = content.get(entry) if isinstance(content, Mapping) else None
        if not isinstance(nested, Mapping):
            raise InputError(f"{path}: expected the entry {entry!r}; found {describe(content)}")
        content = nested
    if not isinstance(content, Mapping) or not content or not isinstance(next(iter(content)), str):
        raise InputError(f"{path}: expected tensors by name; found {describe(content)}")
    return dict(content)


def match_names(
    model: Mapping[str, Tensor], tensors: Mapping[str, Tensor], table: Mapping[str, str], path: str | Path
) -> dict[str, str]:
    """Map our names of tensors to the published ones; names and shapes must match exactly.

    Args:
        model: the model's tensors by name.
        tensors: published tensors by name.
        table: our prefixes by published ones.
        path: file of the published tensors, for messages.

    Raises:
        InputError: a name or shape does not match the model, or two names map to one tensor.
    """
    used: dict[str, str] = {}
    for name, tensor in tensors.items():
        where = f"{path}: {name}"
        ours = to_ours(name, table)
        require(ours is not None, where, "a tensor of these published weights", "an unknown one")
        require(ours in model, where, "no such tensor in the configured model", shape_of(tensor))
        require(ours not in used, where, "one tensor of this meaning", f"{used.get(ours)} too")
        require_shape(where, model[ours], tensor)
        used[ours] = name
    for name, tensor in model.items():
        if name not in used and (published := to_published(name, table)):
            require(False, f"{path}: {published}", f"a tensor of shape {tuple(tensor.shape)}", "nothing")
    return used


def import_weights(
    state: Mapping[str, Tensor],
    config: Mapping[str, Any],
    out: str | Path,
    vggt: str | None,
    release: str | None = None,
    dtype: str = "float32",
) -> list[str]:
    """Write a checkpoint of published weights alone.

    Args:
        state: tensors that the files must provide, on the meta device: those of the model, or,
            without ``release``, of its encoder.
        config: configuration of the model. Without ``release`` the checkpoint keeps the node of the
            encoder alone.
        out: checkpoint to write.
        vggt: a file of VGGT-1B's weights, or a repository of the Hugging Face hub.
        release: the authors' checkpoint, with all other stages.
        dtype: dtype of the encoder, such as ``bfloat16``; heads are float32.

    Returns:
        A report with one line per file, and, without ``release``, one about the other stages.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: a tensor does not fit; the message names the file, the tensor and both shapes.
    """
    require(vggt is not None, "vggt", "a file or facebook/VGGT-1B (heads need their encoder)", None)
    found = fetch(vggt) if is_repository(vggt) else (Path(vggt).name, Path(vggt), None)
    files = [("vggt", *found, VGGT, None)]
    if release is not None:
        files.append(("release", Path(release).name, Path(release), None, RELEASE, RELEASE_ENTRY))
    tensors: dict[str, Tensor] = {}
    facts = {}
    report = []
    for key, label, path, digest, table, entry in files:
        published = published_tensors(path, entry)
        same = Path(out).exists() and Path(out).samefile(path)
        require(not same, "out", f"another file than {key}", str(out))
        skipped = [name for name in published if key == "vggt" and name.startswith(VGGT_IGNORED)]
        wanted = {name: tensor for name, tensor in published.items() if name not in skipped}
        used = match_names(state, wanted, table, path)
        for ours, name in used.items():
            # Heads stay float32: depths and offsets must be accurate to millimetres.
            kind = getattr(torch, dtype) if ours.startswith("encoder.") else torch.float32
            tensors[ours] = published[name].to(kind)
            finite = bool(tensors[ours].isfinite().all())
            require(finite, f"{path}: {name}", f"finite numbers in {dtype}", "others")
        facts[key] = {"name": label, "sha256": digest or sha256(path), "tensors": len(used)}
        counts = sorted(Counter(name.split(".")[0] for name in skipped).items())
        parts = ", ".join(f"{part} {count}" for part, count in counts)
        ignored = f"{len(skipped)} ignored" + f" ({parts})" * bool(parts)
        report.append(f"{key}: {path}: {len(used)} tensors used, {ignored}")
    for name in state:
        require(name in tensors, name, "a model in which every tensor is published", "one of our own")
    encoder = {"encoder": {**config["encoder"], "weights": files[0][1]}}
    write_checkpoint(out, tensors, encoder if release is None else {**config, **encoder}, imported=facts)
    if release is None:
        report.append("the encoder alone: the other stages start afresh in each training, from its seed")
    return report
