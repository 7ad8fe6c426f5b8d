"""Published weights to a checkpoint of this package: every tensor is used, or known to be ignored."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ghgs_lit.errors import InputError, choice, require
from ghgs_lit.model import GHGS, HEADS, STAGES
from ghgs_lit.weights import names
from ghgs_lit.weights.checkpoint import require_shape, shape_of, summary, write_checkpoint
from ghgs_lit.weights.hub import fetch, is_repository, sha256
from ghgs_lit.weights.reading import cast, open_file

DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16, "float16": torch.float16}

#: What the files are, in words.
KINDS = {"vggt": "VGGT-1B", "release": "the authors' release"}

#: Where the depth head starts when there is no checkpoint of the release.
DEPTH_STARTS = ("fresh", "vggt")


@dataclass(frozen=True)
class Source:
    """A file of published weights: ``table`` renames its tensors, ``ignored`` are prefixes left out."""

    key: str
    label: str
    path: Path
    checksum: str
    table: Mapping[str, str]
    ignored: Sequence[str] = ()
    entry: str | None = None
    #: our name: published name, of the tensors that are used
    used: dict[str, str] = field(default_factory=dict)
    skipped: Counter = field(default_factory=Counter)

    def tensors(self) -> dict[str, Tensor]:
        """All tensors of the file, mapped from the disk."""
        content = open_file(self.path)
        if self.entry is not None:
            found = content.get(self.entry) if isinstance(content, Mapping) else None
            if not isinstance(found, Mapping):
                raise InputError(f"{self.path}: expected the entry {self.entry!r}; found {summary(content)}")
            content = found
        if not isinstance(content, Mapping) or not content or not isinstance(next(iter(content)), str):
            raise InputError(f"{self.path}: expected tensors by name; found {summary(content)}")
        return dict(content)

    def own_tensors(self) -> dict[str, Tensor]:
        tensors = self.tensors()
        return {own: tensors[published] for own, published in self.used.items()}

    def match(self, model: Mapping[str, Tensor]) -> None:
        """Decide what becomes of every tensor of the file; refuse names and shapes that do not fit."""
        for name, tensor in self.tensors().items():
            where = f"{self.path}: {name}"
            if name.startswith(tuple(self.ignored)):
                self.skipped[name.split(".")[0]] += 1
                continue
            own = names.to_ours(name, self.table)
            require(own is not None, where, f"a tensor of {KINDS[self.key]}", "an unknown one")
            require(own in model, where, "no such tensor in the configured model", shape_of(tensor))
            require(own not in self.used, where, "one tensor of this meaning", f"{self.used.get(own)} too")
            require_shape(where, model[own], tensor)
            self.used[own] = name

    def report(self) -> str:
        ignored = ", ".join(f"{part} {count}" for part, count in sorted(self.skipped.items()))
        return f"{self.key}: {self.path}: {len(self.used)} tensors used, {self.skipped.total()} ignored" + (
            f" ({ignored})" if ignored else ""
        )


def sources(vggt: str | None, release: str | None, depth_head: str = "fresh") -> Iterator[Source]:
    """The files to read; a repository of the hub is fetched first."""
    require(vggt is not None, "vggt", "a file or facebook/VGGT-1B (heads need their encoder)", None)
    choice("depth_head_start", depth_head, DEPTH_STARTS)
    use_depth = depth_head == "vggt" and release is None
    table = names.VGGT | (names.VGGT_DEPTH if use_depth else {})
    ignored = names.VGGT_DEPTH_IGNORED + names.VGGT_IGNORED
    if use_depth:
        ignored = tuple(part for part in ignored if part not in names.VGGT_DEPTH)
    if is_repository(vggt):
        label, (path, checksum) = vggt, fetch(vggt)
    else:
        path = Path(vggt)
        open_file(path)
        label, checksum = path.name, sha256(path)
    yield Source("vggt", label, path, checksum, table, ignored)
    if release is not None:
        path = Path(release)
        open_file(path)
        yield Source("release", path.name, path, sha256(path), names.RELEASE, entry=names.RELEASE_ENTRY)


def import_weights(
    config: Mapping[str, Any],
    out: str | Path,
    vggt: str | None,
    release: str | None = None,
    dtype: str = "float32",
    depth_head: str = "fresh",
) -> list[str]:
    """Write a checkpoint of the model that ``config`` describes, with published weights; gives a report.

    Without ``release`` the heads start afresh, the depth head from VGGT's where ``depth_head`` is ``vggt``.
    ``dtype`` is the encoder's in the file; the heads are always float32. The published tensors are mapped
    from their files and written from there: the model itself is never in memory.

    Raises:
        FileNotFoundError, InputError: with one line that names the file, the tensor and both shapes.
    """
    choice("dtype", dtype, tuple(DTYPES))
    files = list(sources(vggt, release, depth_head))
    for source in files:
        same = Path(out).exists() and Path(out).samefile(source.path)
        require(not same, "out", f"another file than {source.key}", str(out))
    config = {**config, "encoder": {**config["encoder"], "weights": files[0].label}}
    fresh = () if release is not None else HEADS
    own = GHGS.from_config(config, empty=[stage for stage in STAGES if stage not in fresh]).state_dict()
    started = assign(own, files, fresh)

    def precision(name: str, stored: torch.dtype) -> torch.dtype:
        # Depths and offsets of millimetres hang on the digits of the heads.
        return DTYPES[dtype] if name.startswith("encoder.") else torch.float32

    for source in files:
        tensors = cast(source.own_tensors, precision)
        for name, tensor in tensors.items():
            where = f"{source.path}: {source.used[name]}"
            require(bool(tensor.isfinite().all()), where, f"finite numbers in {dtype}", "others")
        own |= tensors
    facts = {s.key: {"name": s.label, "sha256": s.checksum, "tensors": len(s.used)} for s in files}
    write_checkpoint(out, own, config, imported=facts)
    report = [source.report() for source in files]
    return report + [f"{len(started)} tensors of {', '.join(fresh)} start afresh"] * bool(started)


def assign(own: Mapping[str, Tensor], files: Sequence[Source], fresh: Sequence[str]) -> list[str]:
    """Which tensor of ``own`` each file gives (``Source.used``); returns those that no file does.

    Only stages in ``fresh`` may have such. Looks at names and shapes alone.
    """
    for source in files:
        source.match(own)
    missing = [name for name in own if not any(name in source.used for source in files)]
    for name in missing:
        if name.split(".")[0] not in fresh:
            _refuse_missing(name, own[name], files)
    return missing


def _refuse_missing(name: str, tensor: Tensor, files: Sequence[Source]) -> None:
    for source in reversed(files):
        published = names.to_published(name, source.table)
        if published is not None:
            where, expected = f"{source.path}: {published}", f"a tensor of shape {tuple(tensor.shape)}"
            raise InputError(f"{where}: expected {expected}; found nothing")
    raise InputError(f"{name}: expected a model in which every tensor is published; found one of our own")
