"""Readers of photographs by subject, position and view.

A data set provides a :class:`Reader`, which finds and decodes its files. Resizing, caching and
batching (:class:`Photographs`) and sampling are the same for all data sets.
"""

import contextlib
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ghgs_lit.data.decoding import check_array, check_view
from ghgs_lit.data.sampling import Photo, Sample, photo_name
from ghgs_lit.data.view import View, resize_view
from ghgs_lit.errors import InputError, require
from ghgs_lit.types import Batch, Cameras, Targets

if TYPE_CHECKING:
    from ghgs_lit.data.packed import Packs

PHASES = ("train", "val")
Size = tuple[int, int]


class Reader(ABC):
    """Stored photographs of one phase (``train`` or ``val``).

    A photograph is identified by (position, view); ``view`` is 0 except on rings that were rendered
    with further views between cameras.

    Args:
        strict: raise the first problem of the data set, or collect all in ``problems``.

    Attributes:
        subjects: positions of the cameras of each subject (a person, or one frame of a person).
        problems: what is wrong with the data set, a line each.
    """

    def __init__(self, strict: bool = True) -> None:
        self.strict = strict
        self.subjects: dict[str, tuple[int, ...]] = {}
        self.problems: list[str] = []

    @abstractmethod
    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        """Read one photograph at its stored size.

        Args:
            name: of the subject.
            position: number of the camera, or position on the ring.
            view: its number at the position; 0 except on rings with further views between cameras.
            depth: also read the depth map, if there is any.

        Raises:
            InputError: a file is missing or bad.
        """

    @abstractmethod
    def read_body(self, name: str) -> np.ndarray | None:
        """Body vertices [n, 3] float32 in the world, metres; None if the data has none."""

    @property
    def people(self) -> int:
        """Number of people; fewer than subjects where a subject is one frame of a person."""
        return len(self.subjects)

    def views_at(self, name: str, position: int) -> list[int]:
        """Numbers of the views that have a photograph at a position.

        Args:
            name: of the subject.
            position: number of the camera, or position on the ring.
        """
        return [0]

    def place(self, name: str, position: int, view: int) -> str:
        """Name of a photograph in messages, preferably the path of its mask.

        Args:
            name: of the subject.
            position: number of the camera, or position on the ring.
            view: its number at the position.
        """
        return f"{name}, camera {position}, view {view}"

    def sources(self, name: str) -> Iterable[Path | str]:
        """All that a subject's photographs and body depend on: paths of files, and texts that
        name options of their decoding. Empty: not known, and the subject is never packed
        (:mod:`ghgs_lit.data.packed`)."""
        return ()

    def files(self, name: str) -> Iterable[Path]:
        """Files that a subject's photographs are read from, whether they are there or not."""
        return [source for source in self.sources(name) if isinstance(source, Path)]

    def body_place(self, name: str) -> Path | str:
        """File of a subject's body, whether it is there or not;
        a text where an option has to name it."""
        return f"the body of {name}"

    def checked_view(self, name: str, position: int, view: int, depth: bool) -> View:
        """One photograph as :meth:`read_view`.

        Args:
            name: of the subject.
            position: number of the camera, or position on the ring.
            view: its number at the position.
            depth: also read the depth map, if there is any.

        Raises:
            InputError: a file is missing or bad, the reader gives a wrong view,
                or the mask is empty.
        """
        stored = self.read_view(name, position, view, depth)
        place = self.place(name, position, view)
        check_view(place, stored)
        if not stored.mask.any():
            raise InputError(f"{place}: expected a subject in the mask; found none")
        return stored

    @contextlib.contextmanager
    def collecting(self) -> Iterator[None]:
        """Raise or collect an InputError of the block as a problem of the data set."""
        try:
            yield
        except InputError as error:
            if self.strict:
                raise
            self.problems.append(str(error))

    def problem(self, line: str) -> None:
        """Raise or collect a problem of the data set.

        Args:
            line: ``<place>: expected ...; found ...``.

        Raises:
            InputError: the reader is strict.
        """
        with self.collecting():
            raise InputError(line)


class Photographs:
    """Photographs of a reader: resized, kept in memory, and collated into batches.

    Args:
        reader: finds and decodes them.
        size: (height, width) of the inputs in pixels; None: as stored.
        cache_mb: MiB of decoded views and bodies kept in each process, at least 0; the least
            recently used go first.
        resampling: as for :func:`ghgs_lit.data.view.resize_view`.
        target_size: (height, width) of the targets in pixels; None: as the inputs.

    Attributes:
        packs: packed files by the size of their photographs, which are read first.
    """

    def __init__(
        self,
        reader: Reader,
        size: Size | None = None,
        cache_mb: float = 0,
        resampling: str = "area",
        target_size: Size | None = None,
    ) -> None:
        require(cache_mb >= 0, "data.cache_images_mb", "at least 0", cache_mb)
        self.reader = reader
        self.size = size
        self.target_size = target_size or size
        self.resampling = resampling
        self.packs: Mapping[Size | None, Packs] = {}
        self.cached_bytes = 0
        self.cache_bytes = int(cache_mb * 2**20)
        self._cache: OrderedDict[tuple, View | np.ndarray | None] = OrderedDict()

    def view(
        self, name: str, position: int, view: int = 0, depth: bool = True, size: Size | None = None
    ) -> View:
        """One photograph, resized with its intrinsics.

        Args:
            name: of the subject.
            position: number of the camera, or position on the ring.
            view: its number at the position.
            depth: also read the depth map, if there is any.
            size: (height, width) in pixels; None: ``self.size``.

        Raises:
            InputError: a file is missing or bad, the reader gives a wrong view,
                or the mask is empty.
        """
        size = size or self.size
        packs = self.packs.get(size) or self.packs.get(None)
        packed = packs.view(name, position, view, depth) if packs else None
        if packed is not None:
            return resize_view(packed, size, self.resampling)

        def read() -> View:
            stored = self.reader.checked_view(name, position, view, depth)
            return resize_view(stored, size, self.resampling)

        return self._cached((name, position, view, depth, size), read)

    def body(self, name: str) -> np.ndarray | None:
        """Body vertices as :meth:`Reader.read_body`.

        Raises:
            InputError: they are bad.
        """

        def read() -> np.ndarray | None:
            vertices = self.reader.read_body(name)
            if vertices is not None:
                check_array(f"{name}: body", vertices, [(None, 3)])
            return vertices

        return self._cached((name,), read)

    def _cached(self, key: tuple, read: Callable[[], Any]) -> Any:
        if key in self._cache:
            self._cache.move_to_end(key)
            return self._cache[key]
        value = read()
        nbytes = getattr(value, "nbytes", 0)
        if nbytes <= self.cache_bytes:
            self._cache[key] = value
            self.cached_bytes += nbytes
            while self.cached_bytes > self.cache_bytes:
                self.cached_bytes -= getattr(self._cache.popitem(last=False)[1], "nbytes", 0)
        return value

    def batch(
        self,
        samples: Sequence[Sample],
        sizes: tuple[Size, Size] | None = None,
        depths: bool = True,
        target_depths: bool = True,
    ) -> Batch:
        """Batch of samples with equal numbers of inputs and equal target protocols (or none).

        Args:
            samples: the samples, at least one.
            sizes: (height, width) of the inputs and of the targets in pixels; None: those of the
                photographs.
            depths: whether depth maps of the inputs are read, if there are any.
            target_depths: whether those of the targets are, too; only measurements need them.

        Raises:
            InputError: a file is missing or bad.
        """
        size, target_size = sizes or (self.size, self.target_size)
        photos = [(sample.subject, sample.inputs) for sample in samples]
        maps, names = self._collate(photos, depths, size, with_alpha=True)
        bodies = [self.body(sample.subject) for sample in samples]
        has_bodies = all(body is not None for body in bodies)
        targets = None
        if samples[0].targets:
            photos = [(sample.subject, sample.targets) for sample in samples]
            target_maps, target_names = self._collate(photos, target_depths, target_size)
            targets = Targets(**target_maps, names=target_names, protocols=samples[0].protocols)
        return Batch(
            **maps,
            targets=targets,
            body_vertices=list(map(torch.from_numpy, bodies)) if has_bodies else None,
            subjects=tuple(sample.subject for sample in samples),
            views=names,
        )

    def _collate(
        self,
        photos: Sequence[tuple[str, Sequence[Photo]]],
        depth: bool,
        size: Size | None,
        with_alpha: bool = False,
    ) -> tuple[dict[str, Any], tuple[tuple[str, ...], ...]]:
        """Maps [B, V, ...] and cameras of the photographs of B subjects, and the photographs' names;
        None for a map that a photograph lacks."""
        views = []
        for name, several in photos:
            views += [self.view(name, *photo, depth, size) for photo in several]

        def stack(name: str) -> torch.Tensor | None:
            arrays = [getattr(view, name) for view in views]
            if any(array is None for array in arrays):
                return None
            return torch.from_numpy(np.stack(arrays)).unflatten(0, (len(photos), -1))

        maps = {
            "images": stack("image").permute(0, 1, 4, 2, 3).float().div_(255),
            "masks": stack("mask"),
            "cameras": Cameras(stack("intrinsics"), stack("extrinsics"), *views[0].mask.shape),
            "depths": stack("depth"),
        }
        if with_alpha:
            maps["alpha"] = stack("alpha")
        return maps, tuple(tuple(map(photo_name, several)) for _, several in photos)
