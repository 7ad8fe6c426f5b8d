"""Readers of images by subject, position and view.

A data set implements a :class:`Reader`, which finds and decodes its files. Resizing and batching
(:class:`Photographs`), as well as sampling, are the same for all data sets.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ghgs_lit.data.decoding import check_array, check_view
from ghgs_lit.data.sampling import Photo, Sample, photo_name
from ghgs_lit.data.view import View, resize_view
from ghgs_lit.errors import InputError
from ghgs_lit.types import Batch, Cameras, Targets

if TYPE_CHECKING:
    from ghgs_lit.data.packed import Packs

PHASES = ("train", "val")
Size = tuple[int, int]


class Reader(ABC):
    """Base class of readers of the stored images of one split, such as ``train`` or ``val``.

    An image is identified by (position, view). ``position`` is the index of a camera, or of a position on
    the ring; ``view`` is 0 except on rings that were rendered with further views between cameras.

    Attributes:
        subjects: camera positions of each subject (a person, or one frame of a person).
    """

    def __init__(self) -> None:
        self.subjects: dict[str, tuple[int, ...]] = {}

    @abstractmethod
    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        """Read one image with its mask and camera at its stored size.

        Args:
            position: index of the camera, or position on the ring.
            view: number of the view at the position; 0 except on rings with further views.
            depth: also read the depth map, if there is one.

        Raises:
            InputError: a file is missing or bad.
        """

    @abstractmethod
    def read_body(self, name: str) -> np.ndarray | None:
        """Read the body's vertices [n, 3] float32 in the world, metres; None if the data has none."""

    def views_at(self, name: str, position: int) -> list[int]:
        """Numbers of the views of a subject that exist at a position."""
        return [0]

    def place(self, name: str, position: int, view: int) -> str:
        """Name of an image in messages, preferably the path of its mask."""
        return f"{name}, camera {position}, view {view}"

    def sources(self, name: str) -> Iterable[Path | str]:
        """Everything on which a subject's images depend: paths of files, and texts that describe options of
        their decoding. Empty: unknown, so that the subject is never packed
        (:mod:`ghgs_lit.data.packed`)."""
        return ()

    def files(self, name: str) -> Iterable[Path]:
        """Files from which a subject's images are read; they need not exist."""
        return [source for source in self.sources(name) if isinstance(source, Path)]

    def body_place(self, name: str) -> Path | str:
        """File of a subject's body, which need not exist; a text if an option has to specify it."""
        return f"the body of {name}"

    def read_checked_view(self, name: str, position: int, view: int, depth: bool) -> View:
        """Read one image with :meth:`read_view`, and check it.

        Raises:
            InputError: a file is missing or bad, the reader returns an invalid view, or the mask is
                empty.
        """
        stored = self.read_view(name, position, view, depth)
        place = self.place(name, position, view)
        check_view(place, stored)
        subject = stored.mask if stored.matte is None else stored.matte >= 128
        if not subject.any():
            raise InputError(f"{place}: expected a subject in the mask; found none")
        return stored

    def read_checked_body(self, name: str) -> np.ndarray | None:
        """Read a body with :meth:`read_body`, and check it.

        Raises:
            InputError: it is not an array [n, 3] of finite numbers.
        """
        vertices = self.read_body(name)
        if vertices is not None:
            check_array(f"{name}: body", vertices, [(None, 3)])
        return vertices


class Photographs:
    """Images of a reader: resizes them and collates them into batches.

    Args:
        size: (height, width) of the inputs in pixels; None: as stored.
        resampling: see :func:`ghgs_lit.data.view.resize_view`.
        target_size: (height, width) of the targets in pixels; None: same as the inputs.

    Attributes:
        packs: packed files by the size of their images; they take precedence over the reader.
    """

    def __init__(
        self,
        reader: Reader,
        size: Size | None = None,
        resampling: str = "area",
        target_size: Size | None = None,
    ) -> None:
        self.reader = reader
        self.size = size
        self.target_size = target_size or size
        self.resampling = resampling
        self.packs: dict[Size | None, Packs] = {}

    def view(
        self, name: str, position: int, view: int = 0, depth: bool = True, size: Size | None = None
    ) -> View:
        """Read one image, resized together with its maps and intrinsics.

        Args:
            position: index of the camera, or position on the ring.
            view: number of the view at the position.
            depth: also read the depth map, if there is one.
            size: (height, width) in pixels; None: ``self.size``.

        Raises:
            InputError: see :meth:`Reader.read_checked_view`.
        """
        size = size or self.size
        packs = self.packs.get(size) or self.packs.get(None)
        stored = packs.view(name, position, view, depth) if packs else None
        if stored is None:
            stored = self.reader.read_checked_view(name, position, view, depth)
        return resize_view(stored, size, self.resampling)

    def batch(
        self,
        samples: Sequence[Sample],
        sizes: tuple[Size, Size] | None = None,
        depths: bool = True,
        target_depths: bool = True,
    ) -> Batch:
        """Read samples with equal numbers of inputs and equal target protocols (or none) as a batch.

        Args:
            samples: the samples, at least one.
            sizes: (height, width) of the inputs and of the targets in pixels; None: the configured ones.
            depths: whether depth maps of the inputs are read, if they exist.
            target_depths: whether depth maps of the targets are read; only measurements need them.

        Raises:
            InputError: a file is missing or bad.
        """
        size, target_size = sizes or (self.size, self.target_size)
        photos = [(sample.subject, sample.inputs) for sample in samples]
        maps, names = self._collate(photos, depths, size, with_alpha=True)
        bodies = [self.reader.read_checked_body(sample.subject) for sample in samples]
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
        """Stack the maps [B, V, ...] and cameras of B subjects, with the names of their images; a map that
        any image lacks is None."""
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
