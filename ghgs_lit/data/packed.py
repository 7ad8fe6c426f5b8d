"""Decoded photographs of each subject in one file,
from which training reads at the speed of memory.

A file holds the photographs of a subject that training may draw: of each the part that is not
black, with the mask, the matte and the depth map of that part, and its camera. It is mapped into
memory, so that processes share its pages. Its name has a digest of all that its values depend on
(names, sizes and times of the files that were read, options, the version of this format): changed
data is never read from an old file. Files are written at a subject's first use, atomically: what is
interrupted is written again, and where two processes write the same file, either is right.
"""

import contextlib
import functools
import glob
import hashlib
import itertools
import json
import logging
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import PIL
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ghgs_lit.data.reader import Reader
from ghgs_lit.data.view import View, resize_view
from ghgs_lit.errors import InputError
from ghgs_lit.files import write_atomically

log = logging.getLogger(__name__)

#: Changes with the format of the files and with every change of how photographs are
#: decoded or resized.
_VERSION = 2
#: Files that a process keeps open.
_OPEN_FILES = 128
#: Largest share of the free disk that packed photographs may take.
_SHARE_OF_DISK = 0.5
#: Arrays of a photograph of which the part that is not black is kept, and its whole ones.
_MAPS = ("image", "mask", "matte", "inverse_depth")
_CAMERA = ("intrinsics", "extrinsics")


@dataclass
class Packs:
    """Packed files of the subjects of a reader, at one size of photographs.

    Args:
        reader: of the photographs in their own files; a subject's file depends on its ``sources``.
        folder: where packed files are.
        size: (height, width) of the packed photographs in pixels; None: as stored.
        resampling: how they are resized, as for :func:`ghgs_lit.data.view.resize_view`.
        views: numbers of the views at each position that are packed.
        depths: whether depth maps are packed.
        writes: whether missing files are written; otherwise only those that exist are read.
        paths: file of each subject that was read; None: it cannot be packed.
    """

    reader: Reader
    folder: Path
    size: tuple[int, int] | None
    resampling: str
    views: tuple[int, ...]
    depths: bool
    writes: bool = True
    paths: dict[str, Path | None] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """Name of the settings in names of files."""
        resized = None if self.size is None else (self.size, self.resampling)
        return _digest([_VERSION, PIL.__version__, resized, self.views, self.depths])

    def view(self, name: str, position: int, view: int, depth: bool) -> View | None:
        """A photograph as :meth:`Reader.checked_view` returns it, at the size of the packed ones.

        Args:
            name: of the subject.
            position: number of the camera, or position on the ring.
            view: its number at the position.
            depth: with its depth map, if there is any.

        Returns:
            The photograph; None: it is not packed, or without its depth map.
        """
        pack = self.pack(name)
        return None if pack is None or depth > self.depths else pack.view(position, view, depth)

    def pack(self, name: str) -> "Pack | None":
        """The packed file of a subject, written if it is missing; None: there is none."""
        if name not in self.paths:
            self.paths[name] = self._path(name)
        path = self.paths[name]
        if path is None:
            return None
        pack = _try_open(path)
        if pack is None and self.writes:
            self._write(name, path)
            pack = _try_open(path)
        if pack is None:  # nothing is written or looked for again
            self.paths[name] = None
        return pack

    def _path(self, name: str) -> Path | None:
        """The file of a subject, named after the names, sizes and times of its sources."""
        facts = []
        for source in sorted(map(str, self.reader.sources(name))):
            with contextlib.suppress(OSError):  # an option, or a file that may be missing
                status = os.stat(source)
                facts.append((status.st_size, status.st_mtime_ns, status.st_ctime_ns))
            facts.append(source)
        if not facts:
            return None
        return self.folder / f"{name}-{self.digest}-{_digest(facts)}.safetensors"

    def _write(self, name: str, path: Path) -> None:
        """Write the file of a subject and remove older ones of the same settings."""
        content = {}
        for position, view in itertools.product(self.reader.subjects[name], self.views):
            with contextlib.suppress(InputError):  # raised when it is sampled
                stored = self.reader.checked_view(name, position, view, self.depths)
                content |= _pack_view(position, view, resize_view(stored, self.size, self.resampling))
        try:
            write_atomically(path, lambda temporary: temporary.write_bytes(save(content)))
            for other in self.folder.glob(f"{glob.escape(name)}-{self.digest}-*.safetensors"):
                if other != path:
                    other.unlink(missing_ok=True)
        except OSError as error:
            self.writes = False
            log.warning("%s: expected room for packed photographs; found %s", path, error.strerror)

    def fit(self, most_gb: float, announce: Callable[[str], None]) -> bool:
        """Whether the files of all subjects may take the room that they need on the disk.

        Args:
            most_gb: largest size of all files in GB (10^9 bytes).
            announce: takes a line on their size and place, or why nothing is packed.
        """
        names = list(self.reader.subjects)
        pack = self.pack(names[0])
        if pack is None:
            return False
        stored = sum(file.stat().st_size for file in self.folder.glob(f"*-{self.digest}-*.safetensors"))
        whole = max(pack.bytes * len(names), stored)
        free = shutil.disk_usage(self.folder).free
        size = f"about {whole / 1e9:.2g} GB for {len(names)} subjects in {self.folder}"
        if whole > most_gb * 1e9 or whole - stored > _SHARE_OF_DISK * free:
            reason = f"{size} (data.packed_gb={most_gb:g}, {free / 1e9:.0f} GB are free)"
            announce(f"photographs are not packed: {reason}")
            return False
        announce(f"photographs of training are packed: {size} (data.packed_gb=0: none)")
        return True


class Pack:
    """The packed photographs of one subject, in the file ``path``, which has a size of ``bytes``."""

    def __init__(self, path: Path) -> None:
        self.bytes = path.stat().st_size
        self._file = safe_open(path, "np")
        self._names = frozenset(self._file.keys())

    def view(self, position: int, view: int, depth: bool) -> View | None:
        """One photograph as :meth:`Packs.view`; None: it is not in the file."""
        place = f"{position}/{view}/"
        if place + "box" not in self._names:
            return None
        height, width, top, bottom, left, right = self._file.get_tensor(place + "box").tolist()
        arrays = {name: self._file.get_tensor(place + name) for name in _CAMERA}
        for name in _MAPS:
            arrays[name] = None
            if place + name in self._names and (depth or name != "inverse_depth"):
                part = self._file.get_tensor(place + name)
                arrays[name] = np.zeros((height, width, *part.shape[2:]), part.dtype)
                arrays[name][top:bottom, left:right] = part
        return View(**arrays)


def _pack_view(position: int, number: int, view: View) -> dict[str, np.ndarray]:
    """Arrays of a photograph by their names in the file."""
    maps = {name: array for name in _MAPS if (array := getattr(view, name)) is not None}
    shown = view.image.any(-1)
    for array in maps.values():
        if array.ndim == 2:
            shown = shown | (array != 0)
    places = np.argwhere(shown)
    top, left = places.min(0)
    bottom, right = places.max(0) + 1
    arrays = {name: np.ascontiguousarray(array[top:bottom, left:right]) for name, array in maps.items()}
    arrays |= {name: np.ascontiguousarray(getattr(view, name)) for name in _CAMERA}
    arrays["box"] = np.array([*view.mask.shape, top, bottom, left, right], np.int64)
    return {f"{position}/{number}/{name}": array for name, array in arrays.items()}


def _try_open(path: Path) -> Pack | None:
    """The file at ``path`` if there is a whole one."""
    try:
        return _open(path)
    except (OSError, SafetensorError):
        return None


_open = functools.lru_cache(maxsize=_OPEN_FILES)(Pack)


def _digest(facts: list) -> str:
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:12]


def choose_folder(data: Path) -> Path:
    """Folder of the packed photographs of a data set.

    Args:
        data: folder of the data set.

    Returns:
        A folder in it, or in the user's cache where it cannot be written to.
    """
    in_data = data / "packed"
    if os.access(in_data if in_data.is_dir() else data, os.W_OK | os.X_OK):
        return in_data
    cache = Path(os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit").expanduser()
    return cache / "packed" / _digest([str(data.resolve())])
