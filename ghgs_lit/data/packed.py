"""Packed files with the decoded images of each subject, from which training reads at memory speed.

A file contains the images of one subject that training may sample: the part of each image that is not
black, with its mask, matte and depth map, and the camera. It is memory-mapped, so that processes share
its pages. Its name contains a digest of everything that its values depend on (names, sizes and times of
the source files, options, the version of this format), so that changed data is never read from an old
file. Files are written atomically at a subject's first use: after an interruption they are written
again, and if two processes write the same file, either result is valid.
"""

import contextlib
import errno
import functools
import glob
import hashlib
import itertools
import json
import logging
import os
import shutil
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

#: Version of the format; incremented with each change of how images are stored, decoded or resized.
_VERSION = 2
#: Number of files that a process keeps open.
_OPEN_FILES = 128
#: Share of the disk that packed files leave free.
_KEPT_FREE = 0.1
#: Arrays of a view of which only the part that is not black is stored, and arrays stored whole.
_MAPS = ("image", "mask", "matte", "inverse_depth")
_CAMERA = ("intrinsics", "extrinsics")


@dataclass
class Packs:
    """Packed files of a reader's subjects, at one image size.

    Args:
        reader: reader of the original files; a subject's packed file depends on its ``sources``.
        size: (height, width) of the packed images in pixels; None: as stored.
        resampling: method of resizing, see :func:`ghgs_lit.data.view.resize_view`.
        views: numbers of the views that are packed at each position.
        depths: whether depth maps are packed.
        writes: whether missing files are written; otherwise only existing files are read.
        paths: packed file of each subject read so far; None: it cannot be packed.
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
        """Digest of the settings, part of file names."""
        resized = None if self.size is None else (self.size, self.resampling)
        return _digest([_VERSION, PIL.__version__, resized, self.views, self.depths])

    def view(self, name: str, position: int, view: int, depth: bool) -> View | None:
        """Read a packed view, at the size of the packed files; arguments as for
        :meth:`Reader.read_checked_view`. The file of the subject is written if it is missing.

        Returns:
            The view; None: it is not packed, or is packed without the requested depth map.
        """
        if name not in self.paths:
            self.paths[name] = self._path(name)
        path = self.paths[name]
        if path is None:
            return None
        file = _try_open(path)
        if file is None and self.writes:
            self._write(name, path)
            file = _try_open(path)
        if file is None:
            self.paths[name] = None  # do not try again
            return None
        return None if depth > self.depths else _read_view(file, position, view, depth)

    def _path(self, name: str) -> Path | None:
        """Path of a subject's file, named after the names, sizes and times of its sources; None: unknown
        sources."""
        facts = []
        for source in sorted(map(str, self.reader.sources(name))):
            with contextlib.suppress(OSError):  # a text that describes an option, or a missing file
                status = os.stat(source)
                facts.append((status.st_size, status.st_mtime_ns, status.st_ctime_ns))
            facts.append(source)
        if not facts:
            return None
        return self.folder / f"{name}-{self.digest}-{_digest(facts)}.safetensors"

    def _write(self, name: str, path: Path) -> None:
        """Write the file of a subject, and remove outdated files with the same settings."""
        content = {}
        for position, view in itertools.product(self.reader.subjects[name], self.views):
            with contextlib.suppress(InputError):  # raised later, when the view is sampled
                stored = self.reader.read_checked_view(name, position, view, self.depths)
                content |= _pack_view(position, view, resize_view(stored, self.size, self.resampling))
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            disk = shutil.disk_usage(self.folder)
            if disk.free < _KEPT_FREE * disk.total:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            write_atomically(path, lambda temporary: temporary.write_bytes(save(content)))
            for other in self.folder.glob(f"{glob.escape(name)}-{self.digest}-*.safetensors"):
                if other != path:
                    other.unlink(missing_ok=True)
        except OSError as error:
            self.writes = False
            log.warning("%s: expected room for packed photographs; found %s", path, error.strerror)


def _read_view(file: safe_open, position: int, view: int, depth: bool) -> View | None:
    """Read one view of a packed file, see :meth:`Packs.view`; None: it is not in the file."""
    names = set(file.keys())
    place = f"{position}/{view}/"
    if place + "box" not in names:
        return None
    height, width, top, bottom, left, right = file.get_tensor(place + "box").tolist()
    arrays = {name: file.get_tensor(place + name) for name in _CAMERA}
    for name in _MAPS:
        arrays[name] = None
        if place + name in names and (depth or name != "inverse_depth"):
            part = file.get_tensor(place + name)
            arrays[name] = np.zeros((height, width, *part.shape[2:]), part.dtype)
            arrays[name][top:bottom, left:right] = part
    return View(**arrays)


def _pack_view(position: int, number: int, view: View) -> dict[str, np.ndarray]:
    """Arrays of a view by their names in the file."""
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


_open = functools.lru_cache(maxsize=_OPEN_FILES)(functools.partial(safe_open, framework="np"))


def _try_open(path: Path) -> safe_open | None:
    """Open the file at ``path``; None if it is missing or incomplete."""
    try:
        return _open(path)
    except (OSError, SafetensorError):
        return None


def _digest(facts: list) -> str:
    return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:12]


def choose_folder(data: Path) -> Path:
    """Folder for the packed files of the data set in ``data``: below it if it is writable, otherwise in
    the user's cache."""
    in_data = data / "packed"
    if os.access(in_data if in_data.is_dir() else data, os.W_OK | os.X_OK):
        return in_data
    cache = Path(os.environ.get("GHGS_CACHE") or "~/.cache/ghgs_lit").expanduser()
    return cache / "packed" / _digest([str(data.resolve())])
