"""Training photographs that stay on the device: batches are gathered and resized there.

A loader then sends numbers of photographs (:class:`Drawn`) instead of pixels. Samples, sizes and
cameras are drawn as for photographs that are read; pixels agree with theirs up to the rounding of
means over areas.
"""

import copy
import functools
import itertools
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.utils.data import Dataset

from ghgs_lit.data.batches import TrainingBatches
from ghgs_lit.data.reader import PhotographCache
from ghgs_lit.data.sampling import RING_VIEW, Photo, SampleSpec, photo_name
from ghgs_lit.data.view import DEPTH_SCALE, SAME_SURFACE, View, area_weights, neighbors, resize_view
from ghgs_lit.errors import require
from ghgs_lit.runtime.precision import exact
from ghgs_lit.types import Batch, Cameras, Targets, TensorStruct

log = logging.getLogger(__name__)

Size = tuple[int, int]
#: Largest share of the device's free memory that photographs may take.
_SHARE = 0.5


@dataclass(frozen=True)
class Drawn(TensorStruct):
    """A batch whose photographs are on the device.

    Attributes:
        inputs: numbers [B, V] of the input photographs.
        cameras: their cameras at the drawn size.
        targets: numbers [B, T] of the target photographs.
        target_cameras: their cameras at the drawn size.
        specs: the samples, equal in numbers of views and in protocols.
    """

    inputs: Int[Tensor, "B V"]
    cameras: Cameras
    targets: Int[Tensor, "B T"]
    target_cameras: Cameras
    specs: tuple[SampleSpec, ...]


class ResidentPhotographs:
    """All photographs of training at one size, as bytes on the device.

    Args:
        photographs: where they are read from, once.
        views: numbers of the views at each position.
        depths: whether depth maps are kept.
        stored: keep them as they are stored, to be resized in each step; otherwise at the size of
            ``photographs``.
        device: where they are kept.

    Attributes:
        numbers: number of each photograph by subject, position and view.
        size: (height, width) in pixels.

    Raises:
        InputError: they do not fit into the device's memory,
            or differ in size or in which maps they have.
    """

    def __init__(
        self,
        photographs: PhotographCache,
        views: Sequence[int],
        depths: bool,
        stored: bool,
        device: torch.device,
    ) -> None:
        reader = photographs.reader

        def read(*photo: Any) -> View:
            """A photograph as it is kept, which no cache keeps, too."""
            photograph = reader.checked_view(*photo, depths)
            return (
                photograph if stored else resize_view(photograph, *photographs.size, photographs.resampling)
            )

        self.numbers: dict[tuple[str, int, int], int] = {}
        for name, positions in list(reader.subjects.items()):
            for position in positions:
                for view in sorted({*views} & {*reader.views_at(name, position)}):
                    self.numbers[name, position, view] = len(self.numbers)
        count = len(self.numbers)
        first = _bytes_of(read(*next(iter(self.numbers))))
        _require_room(count * sum(map_.nbytes for map_ in first.values()), device)
        bodies = {name: photographs.body(name) for name in reader.subjects}
        self.bodies = {
            name: None if b is None else torch.tensor(b, device=device) for name, b in bodies.items()
        }
        self.size: Size = tuple(first["masks"].shape)
        self.intrinsics = np.empty((count, 3, 3), np.float32)
        self.extrinsics = torch.empty(count, 4, 4)
        whole = {
            name: torch.empty(count, *m.shape, dtype=m.dtype, device=device) for name, m in first.items()
        }
        for photo, number in self.numbers.items():
            view = read(*photo)
            maps = _bytes_of(view)
            shapes = {name: tuple(map_.shape) for name, map_ in maps.items()}
            expected = {name: tuple(map_.shape) for name, map_ in first.items()}
            place = f"data.resident: {reader.place(*photo)}"
            require(shapes == expected, place, f"maps as of the first photograph, {expected}", shapes)
            self.intrinsics[number] = view.intrinsics
            self.extrinsics[number] = torch.from_numpy(view.extrinsics)
            for name, map_ in maps.items():
                whole[name][number] = map_.to(device)
        size = sum(map_.nbytes for map_ in whole.values()) / 1e9
        log.info("%d photographs of training stay on %s: %.2g GB", count, device, size)
        self.images = whole["images"]
        self.masks = whole["masks"]
        self.mattes = whole.get("mattes")
        self.inverse = whole.get("inverse")

    def without_maps(self) -> "ResidentPhotographs":
        """Numbers and cameras alone."""
        numbers = copy.copy(self)
        numbers.images = numbers.masks = numbers.mattes = numbers.inverse = None
        numbers.bodies = {}
        return numbers

    def rows(self, subject: str, photos: Sequence[Photo]) -> list[int]:
        """Numbers of photographs of a subject.

        Args:
            subject: its name.
            photos: (position, view) of each.

        Raises:
            KeyError: one is not here.
        """
        return [self.numbers[subject, *photo] for photo in photos]

    def cameras(self, rows: Int[Tensor, "B V"], size: Size) -> Cameras:
        """Cameras of photographs at a size, on the CPU,
        as of :func:`ghgs_lit.data.view.resize_view`.

        Args:
            rows: numbers of photographs, on the CPU.
            size: (height, width) in pixels.
        """
        matrices = self.intrinsics[rows.numpy()]
        if size != self.size:
            matrices = matrices.astype(np.float64)
            matrices[..., :2, :] *= np.array([[size[1] / self.size[1]], [size[0] / self.size[0]]])
        return Cameras(torch.from_numpy(matrices.astype(np.float32)), self.extrinsics[rows], *size)

    def maps(
        self, rows: Int[Tensor, "B V"], size: Size, depth: bool
    ) -> tuple[Tensor, Tensor, Tensor | None, Tensor | None]:
        """Pixels of photographs at a size.

        Args:
            rows: numbers of photographs.
            size: (height, width) in pixels.
            depth: whether depths are asked for.

        Returns:
            Images [B, V, 3, h, w] in [0, 1], and masks, depths in metres and mattes in [0, 1]
            [B, V, h, w]; None for depths and mattes that there are none of.
        """
        mattes = None if self.mattes is None else self.mattes[rows]
        inverse = self.inverse[rows] if depth and self.inverse is not None else None
        images = self.images[rows]
        masks = self.masks[rows]
        images = images.permute(0, 1, 4, 2, 3)
        if size != self.size:
            images = _levels(images, size)
            if mattes is None:
                masks = shown = _area_means(masks, size) > 0.5 - 1e-6
            else:
                mattes = _levels(mattes, size)
                masks = mattes >= 128
                shown = mattes > 0
            if inverse is not None:
                inverse = _centered_depth(inverse.to(torch.int32) & 0xFFFF, size) * shown
        elif inverse is not None:
            inverse = inverse.to(torch.int32) & 0xFFFF
        known = None if inverse is None else _depths(inverse)
        return images.float() / 255, masks, known, None if mattes is None else mattes.float() / 255

    def batch(self, drawn: Drawn, targets: "ResidentPhotographs") -> Batch:
        """The batch of a loader's numbers.

        Args:
            drawn: the numbers, on the device.
            targets: where target photographs are.
        """
        images, masks, depths, alpha = self.maps(drawn.inputs, _size(drawn.cameras), True)
        seen, target_masks, _, _ = targets.maps(drawn.targets, _size(drawn.target_cameras), False)
        bodies = [self.bodies[spec.subject] for spec in drawn.specs]
        return Batch(
            images=images,
            masks=masks,
            cameras=drawn.cameras,
            targets=Targets(
                images=seen,
                masks=target_masks,
                cameras=drawn.target_cameras,
                names=tuple(tuple(map(photo_name, spec.targets)) for spec in drawn.specs),
                protocols=drawn.specs[0].protocols,
            ),
            body_vertices=None if None in bodies else bodies,
            depths=depths,
            alpha=alpha,
            subjects=tuple(spec.subject for spec in drawn.specs),
            views=tuple(tuple(map(photo_name, spec.inputs)) for spec in drawn.specs),
        )


@dataclass(frozen=True)
class DrawnBatches(Dataset):
    """Item ``step`` has the numbers of the photographs of that step; where a step is imperfect,
    or has a photograph that is not on the device, it is the batch itself, which the loading
    process makes.

    Args:
        batches: makes batches from photographs that are read.
        inputs: numbers of the inputs.
        targets: numbers of the targets.
    """

    batches: TrainingBatches
    inputs: ResidentPhotographs
    targets: ResidentPhotographs

    def __len__(self) -> int:
        return len(self.batches)

    def __getitem__(self, step: int) -> Drawn | Batch:
        batches = self.batches
        if not batches.augmentation.is_exact(batches.sampler.seed, step):
            return batches[step]
        specs = batches.sampler.batch(step, batches.rank, batches.world)
        try:
            inputs = torch.tensor([self.inputs.rows(spec.subject, spec.inputs) for spec in specs])
            targets = torch.tensor([self.targets.rows(spec.subject, spec.targets) for spec in specs])
        except KeyError:  # of a subject that joined later
            return batches[step]
        size, target_size = batches.sizes(step)
        cameras = self.inputs.cameras(inputs, size)
        return Drawn(inputs, cameras, targets, self.targets.cameras(targets, target_size), tuple(specs))

    def __getstate__(self) -> dict[str, Any]:
        """Loading processes get the numbers, not the pixels."""
        return {**self.__dict__, "inputs": self.inputs.without_maps(), "targets": self.targets.without_maps()}


def resident_batches(batches: TrainingBatches, device: torch.device) -> DrawnBatches:
    """Batches whose photographs are put on a device now.

    Args:
        batches: makes batches from photographs that are read.
        device: where its model is.

    Raises:
        InputError: photographs do not fit there, or are drawn at larger sizes than they are stored.
    """
    builder = batches.builder
    augmentation = batches.augmentation
    views = (RING_VIEW, *batches.sampler.targets.training_views)
    varies = augmentation.varies_sizes
    inputs = ResidentPhotographs(builder.inputs, views, builder.depths, varies, device)
    if varies:
        area = builder.inputs.resampling == "area"
        require(area, "data.resident", "off with data.resampling=release and sizes that vary", "device")
        drawn = [*(augmentation.sizes or (builder.inputs.size,)), builder.targets.size]
        heights, widths = zip(*drawn, strict=True)
        fits = max(heights) <= inputs.size[0] and max(widths) <= inputs.size[1]
        require(fits, "data.resident", f"off, or sizes of at most {inputs.size} as stored", drawn)
        return DrawnBatches(batches, inputs, inputs)
    if builder.targets is builder.inputs:
        return DrawnBatches(batches, inputs, inputs)
    return DrawnBatches(batches, inputs, ResidentPhotographs(builder.targets, views, False, False, device))


def _size(cameras: Cameras) -> Size:
    return cameras.height, cameras.width


def _bytes_of(view: View) -> dict[str, Tensor]:
    """The maps of a photograph, by name; PyTorch has few functions of unsigned integers
    of 16 bits."""
    inverse = None if view.inverse_depth is None else view.inverse_depth.view(np.int16)
    maps = {"images": view.image, "masks": view.mask, "mattes": view.matte, "inverse": inverse}
    return {name: torch.tensor(map_) for name, map_ in maps.items() if map_ is not None}


def _require_room(needed: int, device: torch.device) -> None:
    if device.type == "cuda":
        free = torch.cuda.mem_get_info(device)[0]
        expected = f"off, or {needed / _SHARE / 1e9:.1f} GB of free memory on {device}"
        require(needed <= _SHARE * free, "data.resident", expected, f"{free / 1e9:.1f} GB")


def _depths(inverse: Int[Tensor, "*batch h w"]) -> Float[Tensor, "*batch h w"]:
    """Depths in metres, 0 where unknown."""
    return torch.where(inverse > 0, DEPTH_SCALE / inverse.clamp(min=1).float(), 0)


def _area_means(maps: Shaped[Tensor, "*batch H W"], size: Size) -> Float[Tensor, "*batch h w"]:
    """Means over the areas of new pixels."""
    height, width = maps.shape[-2:]
    down = _weights(height, size[0], maps.device)
    across = _weights(width, size[1], maps.device)
    with exact(maps.device.type):
        return down @ maps.float() @ across.T


def _levels(maps: Shaped[Tensor, "*batch H W"], size: Size) -> Float[Tensor, "*batch h w"]:
    """Means over the areas of new pixels as whole numbers, as they are stored in bytes."""
    return torch.floor(_area_means(maps, size) + 0.5)


@functools.lru_cache(maxsize=64)
def _weights(old: int, new: int, device: torch.device) -> Float[Tensor, "new old"]:
    return torch.from_numpy(area_weights(old, new).toarray()).to(device)


def _centered_depth(inverse: Int[Tensor, "*batch H W"], size: Size) -> Int[Tensor, "*batch h w"]:
    """Inverse depths at the centres of new pixels, as :func:`ghgs_lit.data.view.centered_depth`."""
    pairs = [_neighbors(*pair, inverse.device) for pair in zip(inverse.shape[-2:], size, strict=True)]
    (rows, down), (columns, across) = pairs
    known = inverse.float()
    places = list(itertools.product((0, 1), (0, 1)))
    corners = torch.stack([known[..., rows[i], :][..., columns[j]] for i, j in places])
    weights = torch.stack([down[i][:, None] * across[j] for i, j in places])
    weights = weights.reshape(4, *(1,) * (inverse.dim() - 2), *size)
    front = torch.where(weights > 0, corners, 0).amax(0)
    least = ((1 - SAME_SURFACE) * front).clamp(min=0.5)  # 0 is unknown
    counted = weights * (corners >= least)
    total = counted.sum(0)
    mean = (counted * corners).sum(0) / torch.where(total > 0, total, 1)
    return torch.where(total > 0, mean.round(), 0).to(torch.int32)


@functools.lru_cache(maxsize=64)
def _neighbors(old: int, new: int, device: torch.device) -> tuple[Tensor, Tensor]:
    indices, weights = neighbors(old, new)
    return torch.from_numpy(indices).to(device), torch.from_numpy(weights).to(device)
