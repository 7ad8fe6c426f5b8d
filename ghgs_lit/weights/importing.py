"""Import of published weights to a checkpoint: every tensor is used, or listed as ignored."""

import hashlib
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ghgs_lit.errors import InputError, installed, require
from ghgs_lit.weights import names
from ghgs_lit.weights.checkpoint import describe, require_shape, shape_of, write_checkpoint
from ghgs_lit.weights.reading import cast, open_file

FILE = "model.safetensors"


def is_repository(name: str) -> bool:
    """Whether a name looks like ``owner/repository`` rather than like a file.

    Args:
        name: of a source of weights.

    Returns:
        False where there is a file of that name, or where it ends as a file of weights does.
    """
    return (
        re.fullmatch(r"[\w.-]+/[\w.-]+", name) is not None
        and Path(name).suffix not in (".pt", ".pth", ".bin", ".ckpt", ".safetensors")
        and not Path(name).exists()
    )


def fetch(repository: str) -> tuple[str, Path, str]:
    """Weights of a repository, from the local cache or the hub.

    Args:
        repository: ``owner/repository``.

    Returns:
        Its name, the path of the file and its SHA-256.

    Raises:
        InputError: the package, the network or the repository is missing, or the checksum is not
            the published one.
    """
    hub = installed("huggingface_hub", "hub", repository)
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
    # The name of a file in the cache is the published checksum.
    digest = sha256(path)
    published = path.resolve().name
    is_whole = digest == published or not re.fullmatch(r"[0-9a-f]{64}", published)
    require(is_whole, str(path.resolve()), f"SHA-256 {published}", f"{digest}: a broken download: delete it")
    return repository, path, digest


def sha256(path: Path) -> str:
    """SHA-256 of a file in hexadecimal digits."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


KINDS = {"vggt": "VGGT-1B", "release": "the authors' release"}  #: Names in messages


@dataclass(frozen=True)
class Source:
    """A file of published weights."""

    key: str  #: ``vggt`` or ``release``
    label: str  #: the repository's or file's name, for the checkpoint
    path: Path
    checksum: str  #: SHA-256
    table: Mapping[str, str]  #: our prefixes by published ones
    ignored: Sequence[str] = ()  #: prefixes of tensors that are not used
    entry: str | None = None  #: the key of the file that holds its tensors, if any
    used: dict[str, str] = field(default_factory=dict)  #: published names of used tensors by ours
    #: ignored tensors by the first part of their name
    skipped: Counter = field(default_factory=Counter)

    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the file, mapped from the disk.

        Returns:
            Tensors by published names.

        Raises:
            InputError: the file holds something else, or lacks ``entry``.
        """
        content = open_file(self.path)
        if self.entry is not None:
            nested = content.get(self.entry) if isinstance(content, Mapping) else None
            if not isinstance(nested, Mapping):
                raise InputError(f"{self.path}: expected the entry {self.entry!r}; found {describe(content)}")
            content = nested
        if not isinstance(content, Mapping) or not content or not isinstance(next(iter(content)), str):
            raise InputError(f"{self.path}: expected tensors by name; found {describe(content)}")
        return dict(content)

    def used_tensors(self) -> dict[str, Tensor]:
        """The used tensors by our names."""
        tensors = self.tensors()
        return {ours: tensors[published] for ours, published in self.used.items()}

    def match(self, model: Mapping[str, Tensor]) -> None:
        """Fill ``used`` and ``skipped``.

        Args:
            model: the model's tensors by name.

        Raises:
            InputError: a name or a shape does not fit the model's tensors,
                or two names mean one tensor.
        """
        for name, tensor in self.tensors().items():
            where = f"{self.path}: {name}"
            if name.startswith(tuple(self.ignored)):
                self.skipped[name.split(".")[0]] += 1
                continue
            ours = names.to_ours(name, self.table)
            require(ours is not None, where, f"a tensor of {KINDS[self.key]}", "an unknown one")
            require(ours in model, where, "no such tensor in the configured model", shape_of(tensor))
            require(ours not in self.used, where, "one tensor of this meaning", f"{self.used.get(ours)} too")
            require_shape(where, model[ours], tensor)
            self.used[ours] = name

    def report(self) -> str:
        """Numbers of used and ignored tensors, as one line."""
        parts = ", ".join(f"{part} {count}" for part, count in sorted(self.skipped.items()))
        ignored = f"{self.skipped.total()} ignored" + f" ({parts})" * bool(parts)
        return f"{self.key}: {self.path}: {len(self.used)} tensors used, {ignored}"


def sources(vggt: str | None, release: str | None) -> Iterator[Source]:
    """The files to read; a repository of the hub is downloaded first.

    Args:
        vggt: a file of VGGT-1B's weights, or a repository of the hub.
        release: the authors' checkpoint, if it is wanted.

    Yields:
        The encoder's file, then that of the other stages.

    Raises:
        InputError: ``vggt`` is None, or as :func:`fetch` and :func:`local`.
    """
    require(vggt is not None, "vggt", "a file or facebook/VGGT-1B (heads need their encoder)", None)
    file = fetch(vggt) if is_repository(vggt) else local(vggt)
    yield Source("vggt", *file, names.VGGT, names.VGGT_IGNORED)
    if release is not None:
        yield Source("release", *local(release), names.RELEASE, entry=names.RELEASE_ENTRY)


def local(name: str) -> tuple[str, Path, str]:
    """A file of weights.

    Args:
        name: its path.

    Returns:
        Its name, path and SHA-256.

    Raises:
        FileNotFoundError: as :func:`open_file`.
        InputError: as :func:`open_file`.
    """
    path = Path(name)
    open_file(path)
    return path.name, path, sha256(path)


def import_weights(
    state: Mapping[str, Tensor],
    config: Mapping[str, Any],
    out: str | Path,
    vggt: str | None,
    release: str | None = None,
    dtype: str = "float32",
) -> list[str]:
    """Write a checkpoint with published weights and nothing else.

    Args:
        state: tensors that the files must fill, on the meta device: those of the model, or without
            ``release`` those of its encoder.
        config: nodes of the model. Without ``release`` the checkpoint keeps that of the
            encoder alone.
        out: the checkpoint.
        vggt: a file of VGGT-1B's weights, or a repository of the Hugging Face hub.
        release: the authors' checkpoint, with all other stages.
        dtype: precision of the encoder, such as ``bfloat16``; heads are float32.

    Returns:
        A report: a line for each file, and without ``release`` one about the other stages.

    Raises:
        FileNotFoundError: a file is missing.
        InputError: a tensor does not fit; names the file, the tensor and both shapes.
    """
    files = list(sources(vggt, release))
    for source in files:
        same = Path(out).exists() and Path(out).samefile(source.path)
        require(not same, "out", f"another file than {source.key}", str(out))
    match_files(state, files)
    tensors: dict[str, Tensor] = {}

    def precision(name: str, stored: torch.dtype) -> torch.dtype:
        # Depths and offsets of millimetres need the precision of the heads.
        return getattr(torch, dtype) if name.startswith("encoder.") else torch.float32

    for source in files:
        converted = cast(source.used_tensors, precision)
        for name, tensor in converted.items():
            where = f"{source.path}: {source.used[name]}"
            require(bool(tensor.isfinite().all()), where, f"finite numbers in {dtype}", "others")
        tensors |= converted
    encoder = {"encoder": {**config["encoder"], "weights": files[0].label}}
    config = encoder if release is None else {**config, **encoder}
    facts = {s.key: {"name": s.label, "sha256": s.checksum, "tensors": len(s.used)} for s in files}
    write_checkpoint(out, tensors, config, imported=facts)
    heads = "the encoder alone: the other stages start afresh in each training, from its seed"
    return [*(source.report() for source in files), *([heads] if release is None else [])]


def match_files(state: Mapping[str, Tensor], files: Sequence[Source]) -> None:
    """Fill ``Source.used`` by names and shapes.

    Args:
        state: the model's tensors by name.
        files: that together hold all of them.

    Raises:
        InputError: a tensor is in no file, or does not fit.
    """
    for source in files:
        source.match(state)
    for name in state:
        if any(name in source.used for source in files):
            continue
        for source in reversed(files):
            published = names.to_published(name, source.table)
            expected = f"a tensor of shape {tuple(state[name].shape)}"
            require(published is None, f"{source.path}: {published}", expected, "nothing")
        require(False, name, "a model in which every tensor is published", "one of our own")
