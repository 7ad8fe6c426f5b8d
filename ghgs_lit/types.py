"""The data that the stages exchange.

Conventions of the whole package:

* camera axes are OpenCV's: x right, y down, z forward; ``extrinsics`` map the world to the camera;
* ``intrinsics`` are in pixels and pixel ``(row i, column j)`` has its centre at
  ``(u, v) = (j + 0.5, i + 0.5)``; a calibration made with OpenCV puts centres at integers, so add
  0.5 to its ``cx`` and ``cy`` before any resize;
* quaternions are ``(w, x, y, z)``; lengths are metres; depth is z in the camera;
* images are float in ``[0, 1]``, RGB, on a black background outside the mask.

Letters in shapes: ``B`` batch, ``V`` input views, ``T`` target views, ``H W`` input size, ``h w``
target size (of tokens: rows and columns), ``N`` packed Gaussians or tokens, ``L`` layers.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.extents import Extent, extents, true_places

_T = TypeVar("_T")

#: Pixels decoded by dense heads: whole views, or windows around the subject.
DecodedPixels = Literal["all", "subject"]


def map_tensors(value: _T, fn: Callable[[Tensor], Tensor]) -> _T:
    """Apply a function to every tensor inside nested dataclasses, (named) tuples, lists and dicts.

    Args:
        value: a tensor, such a container, or any other value, which is returned unchanged.
        fn: maps a tensor to its replacement.

    Returns:
        A container of the same type.
    """
    if isinstance(value, Tensor):
        return fn(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        changes = {f.name: map_tensors(getattr(value, f.name), fn) for f in dataclasses.fields(value)}
        return dataclasses.replace(value, **changes)
    if isinstance(value, (tuple, list)):
        items = [map_tensors(item, fn) for item in value]
        return type(value)(*items) if hasattr(value, "_fields") else type(value)(items)
    if isinstance(value, dict):
        return {key: map_tensors(item, fn) for key, item in value.items()}
    return value


class TensorStruct:
    """``to``, ``detach`` and ``pin_memory`` for a dataclass of tensors."""

    def to(self, *args, **kwargs):
        """Move to a device (dtypes are kept: geometry stays float32 or wider, masks stay bool)."""
        return map_tensors(self, lambda t: t.to(*args, **kwargs))

    def detach(self):
        """The same tensors, detached from the autograd graph."""
        return map_tensors(self, Tensor.detach)

    def pin_memory(self):
        """The tensors in page-locked memory, for fast copies to a GPU."""
        return map_tensors(self, Tensor.pin_memory)


@dataclass(frozen=True)
class Cameras(TensorStruct):
    """Pinhole cameras with any leading dimensions, all of one image size in pixels."""

    intrinsics: Float[Tensor, "*batch 3 3"]
    extrinsics: Float[Tensor, "*batch 4 4"]
    height: int
    width: int

    @property
    def shape(self) -> torch.Size:
        return self.intrinsics.shape[:-2]

    @property
    def centers(self) -> Float[Tensor, "*batch 3"]:
        """Camera centres in the world, ``-R^T t``."""
        rotation = self.extrinsics[..., :3, :3]
        translation = self.extrinsics[..., :3, 3]
        # Elementwise: autocast would run a matrix product in half precision.
        return -(rotation * translation[..., :, None]).sum(-2)

    @cached_property
    def has_skew(self) -> bool:
        """Whether any ``K[0, 1]`` is not 0; a device-to-host synchronisation at first use, unless
        :meth:`note_skew` was called."""
        return bool(self.any_skew)

    @property
    def any_skew(self) -> Bool[Tensor, ""]:
        """:attr:`has_skew` as a tensor on the cameras' device, without a synchronisation."""
        return (self.intrinsics[..., 0, 1] != 0).any()

    def note_skew(self, has_skew: bool) -> None:
        """Store :attr:`has_skew` that was read together with other values."""
        self.__dict__.update(has_skew=has_skew)

    def __getitem__(self, index) -> "Cameras":
        return dataclasses.replace(self, intrinsics=self.intrinsics[index], extrinsics=self.extrinsics[index])

    def resize(self, height: int, width: int) -> "Cameras":
        """The same cameras for an image resized to ``height`` x ``width`` pixels."""
        intrinsics = self.intrinsics.clone()
        intrinsics[..., 0, :] *= width / self.width
        intrinsics[..., 1, :] *= height / self.height
        return dataclasses.replace(self, intrinsics=intrinsics, height=height, width=width)

    def crop(self, top: int, left: int, height: int, width: int) -> "Cameras":
        """The same cameras for a crop of the image.

        Args:
            top: first row of the crop; negative: number of rows padded above the image.
            left: first column of the crop; negative: number of columns padded on the left.
            height: of the crop in pixels.
            width: of the crop in pixels.

        Returns:
            Cameras with shifted principal points.
        """
        intrinsics = self.intrinsics.clone()
        intrinsics[..., 0, 2] -= left
        intrinsics[..., 1, 2] -= top
        return dataclasses.replace(self, intrinsics=intrinsics, height=height, width=width)


@dataclass(frozen=True)
class Targets(TensorStruct):
    """Target images, from cameras other than the input cameras.

    ``names``: names of the images of each subject. ``protocols``: the target protocol of each of the
    ``T`` targets, the same for all subjects. ``depths``: true z-depths in metres, 0 where unknown;
    None: unknown.
    """

    images: Float[Tensor, "B T 3 h w"]
    masks: Bool[Tensor, "B T h w"]
    cameras: Cameras
    names: tuple[tuple[str, ...], ...] = ()
    protocols: tuple[str, ...] = ()
    depths: Float[Tensor, "B T h w"] | None = None

    def of_protocol(self, name: str) -> "Targets":
        """The targets of one protocol."""
        chosen = [number for number, protocol in enumerate(self.protocols) if protocol == name]
        parts = (each[:, chosen] for each in (self.images, self.masks, self.cameras))
        names = []
        for subject in self.names:
            names.append(tuple(subject[number] for number in chosen))
        depths = None if self.depths is None else self.depths[:, chosen]
        return Targets(*parts, tuple(names), (name,) * len(chosen), depths)


@dataclass(frozen=True)
class Batch(TensorStruct):
    """Input views of ``B`` subjects, with masks, cameras and optional annotations.

    ``body_vertices``: points of the body's surface in metres. ``depths``: true z-depths in metres, 0
    where unknown. ``alpha``: soft mattes: the covered share of each pixel, by which its colour is
    multiplied. ``log_gains``: logarithms of the cameras' gains, by which images are already divided.
    ``views``: names of the input views of each subject. None: unknown.
    """

    images: Float[Tensor, "B V 3 H W"]
    masks: Bool[Tensor, "B V H W"]
    cameras: Cameras
    targets: Targets | None = None
    body_vertices: list[Float[Tensor, "_ 3"]] | None = None
    depths: Float[Tensor, "B V H W"] | None = None
    alpha: Float[Tensor, "B V H W"] | None = None
    log_gains: Float[Tensor, "B V 3"] | None = None
    subjects: tuple[str, ...] = ()
    views: tuple[tuple[str, ...], ...] = ()

    def of_views(self, views: Sequence[int]) -> "Batch":
        """The batch with only the input views at these indices, in this order, and the same targets."""
        views = list(views)
        names = ("images", "masks", "cameras", "depths", "alpha", "log_gains")
        parts = {name: value[:, views] for name in names if (value := getattr(self, name)) is not None}
        kept = []
        for subject in self.views:
            kept.append(tuple(subject[view] for view in views))
        return dataclasses.replace(self, **parts, views=tuple(kept))

    def recolor(self, **changes: Tensor) -> "Batch":
        """The batch with other colours and the same masks, whose extents stay cached."""
        changed = dataclasses.replace(self, **changes)
        names = ("extents", "pixels", "_pixels")
        changed.__dict__.update({name: vars(self)[name] for name in names if name in vars(self)})
        return changed

    def once(self, function: Callable[["Batch"], _T]) -> _T:
        """``function(self)``, computed once and cached for all stages that pass the same function."""
        known = self.__dict__.setdefault("_known", {})
        if function not in known:
            known[function] = function(self)
        return known[function]

    def note(
        self, extents: Sequence[Extent], pixels: Callable[[], Int[Tensor, " n"]], has_skew: bool
    ) -> None:
        """Cache statistics of the masks and cameras that were read for a plan.

        Args:
            extents: :attr:`extents`.
            pixels: returns :attr:`pixels` in ascending order; called at first use.
            has_skew: :attr:`Cameras.has_skew` of the input cameras.
        """
        self.__dict__.update(extents=list(extents), _pixels=pixels)
        self.cameras.note_skew(has_skew)

    @cached_property
    def extents(self) -> list[Extent]:
        """Extent of the subject in each image ``b * V + v``; may cause a device-to-host
        synchronisation at first use."""
        return extents(self.masks.flatten(0, 1))

    @cached_property
    def pixels(self) -> Int[Tensor, " n"]:
        """Flat indices [n] of the subject's pixels among the pixels of all images."""
        noted = self.__dict__.get("_pixels")
        return true_places(self.masks, sum(e.count for e in self.extents)) if noted is None else noted()


@dataclass(frozen=True)
class DepthBounds(TensorStruct):
    """The nearest and the farthest z-depth, in metres, at which each pixel's ray can meet the
    subject."""

    near: Float[Tensor, "B V H W"]
    far: Float[Tensor, "B V H W"]


@dataclass(frozen=True)
class Tokens(TensorStruct):
    """Tokens of the kept patches of the whole batch, packed.

    Token ``n`` is the patch at ``row[n]``, ``column[n]`` of image ``image[n]`` (``b * V + v``);
    tokens are ordered by image, row, column. ``grid`` is ``(B, V, h, w)``. ``latent``: embeddings E
    of the encoder's read-out layers. ``semantic``: features F, detached: they weight the attention,
    whose gradient does not train them. ``real``: mask of valid tokens, if each image has the same
    number of rows, a shape bucket; None: all are valid.
    """

    latent: tuple[Float[Tensor, "N C"], ...]
    semantic: Float[Tensor, "N S"]
    image: Int[Tensor, " N"]
    row: Int[Tensor, " N"]
    column: Int[Tensor, " N"]
    grid: tuple[int, int, int, int]
    patch_size: int
    real: Bool[Tensor, " N"] | None = None

    @property
    def is_dense(self) -> bool:
        """Whether every patch of every image is present."""
        return self.real is None and self.image.shape[0] == math.prod(self.grid)

    def select(self, index: Tensor | slice) -> "Tokens":
        """The tokens at ``index`` (a slice, a mask or indices), on the same grid."""
        parts = {name: getattr(self, name)[index] for name in ("semantic", "image", "row", "column")}
        parts["real"] = None if self.real is None else self.real[index]
        return dataclasses.replace(self, latent=tuple(layer[index] for layer in self.latent), **parts)

    def of_images(self, images: slice) -> "Tokens":
        """The tokens of consecutive images ``b * V + v``, as one element; may cause a device-to-host
        synchronisation."""
        b, v, h, w = self.grid
        if images == slice(0, b * v):
            part = self
        elif self.is_dense or self.real is not None:
            rows = self.image.shape[0] // (b * v)
            part = self.select(slice(images.start * rows, images.stop * rows))
        else:
            ends = torch.tensor((images.start, images.stop), device=self.image.device)
            part = self.select(slice(*torch.searchsorted(self.image, ends).tolist()))
        grid = (1, images.stop - images.start, h, w)
        return dataclasses.replace(part, image=part.image - images.start, grid=grid)

    def in_precision(self, dtype: torch.dtype) -> "Tokens":
        """The tokens in ``dtype``; unchanged under autocast, which determines the precision."""
        if torch.is_autocast_enabled(self.semantic.device.type) or self.latent[0].dtype == dtype:
            return self
        latent = tuple(layer.to(dtype) for layer in self.latent)
        return dataclasses.replace(self, latent=latent, semantic=self.semantic.to(dtype))

    def maps(self, layer: int) -> Float[Tensor, "BV C h w"]:
        """One layer on the token grid; 0 at patches without a token."""
        b, v, h, w = self.grid
        values = self.latent[layer]
        if not self.is_dense:
            count = b * v * h * w
            flat = (self.image * h + self.row) * w + self.column
            spare = 0
            if self.real is not None:
                flat = torch.where(self.real, flat, count)
                spare = 1
            values = values.new_zeros(count + spare, values.shape[1]).index_copy(0, flat, values)[:count]
        return values.reshape(b * v, h, w, -1).permute(0, 3, 1, 2)


@dataclass(frozen=True)
class DepthMaps(TensorStruct):
    """Z-depth of each pixel in metres, and its bounds, if any."""

    depth: Float[Tensor, "B V H W"]
    valid: Bool[Tensor, "B V H W"]
    confidence: Float[Tensor, "B V H W"]
    bounds: DepthBounds | None = None


@dataclass(frozen=True)
class Points(TensorStruct):
    """World points of pixels and of tokens, in metres. Invalid ones are finite but meaningless.
    ``token_image`` is the image (``b * V + v``) of each token."""

    pixels: Float[Tensor, "B V H W 3"]
    valid: Bool[Tensor, "B V H W"]
    tokens: Float[Tensor, "N 3"]
    tokens_valid: Bool[Tensor, " N"]
    token_image: Int[Tensor, " N"]


@dataclass(frozen=True)
class Gaussians(TensorStruct):
    """3D Gaussians of a batch, packed; ``splits[b]`` of them belong to element ``b``.

    ``quaternions`` need not have unit norm; ``scales`` are standard deviations in metres; ``colors``
    may have any number of channels. ``image`` (``b * V + v``) and ``pixel`` (row-major index): the
    input pixel of each Gaussian, if any. ``low_pass`` (px^2) and ``antialiased``: the renderer's
    settings (:class:`ghgs_lit.rendering.RasterSettings`) that they were made for. ``metre``: the
    length of a metre in the unit of each element's world (:mod:`ghgs_lit.geometry.frame`); None: 1.
    """

    means: Float[Tensor, "N 3"]
    quaternions: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    colors: Float[Tensor, "N C"]
    splits: tuple[int, ...]
    image: Int[Tensor, " N"] | None = None
    pixel: Int[Tensor, " N"] | None = None
    low_pass: float = 0.3
    antialiased: bool = False
    metre: Float[Tensor, " B"] | None = None

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def is_finite(self) -> Bool[Tensor, " N"]:
        """Which Gaussians have only finite values; renderers skip the others."""
        fields = (self.means, self.quaternions, self.scales, self.opacities[:, None], self.colors)
        return torch.stack([field.isfinite().all(1) for field in fields]).all(0)

    def _rows(self) -> dict[str, Tensor]:
        """The tensors with a row for each Gaussian, by name."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        return {n: value for n, value in values.items() if n != "metre" and isinstance(value, Tensor)}

    def select(self, index: Tensor | slice, splits: tuple[int, ...]) -> "Gaussians":
        """The Gaussians at ``index`` (slice, mask or indices); ``splits``: their number in each
        element."""
        changes = {name: values[index] for name, values in self._rows().items()}
        return dataclasses.replace(self, **changes, splits=splits)

    def __getitem__(self, element: int) -> "Gaussians":
        """The Gaussians of one batch element.

        Args:
            element: its index; negative: from the end.

        Returns:
            The Gaussians, as one element.

        Raises:
            IndexError: there is no such element.
        """
        if not -len(self.splits) <= element < len(self.splits):
            raise IndexError(f"batch element {element} of Gaussians with {len(self.splits)} elements")
        element %= len(self.splits)
        start = sum(self.splits[:element])
        count = self.splits[element]
        gaussians = self.select(slice(start, start + count), (count,))
        metre = None if self.metre is None else self.metre[element : element + 1]
        return dataclasses.replace(gaussians, metre=metre)


@dataclass(frozen=True)
class Prediction(TensorStruct):
    """Result of ``model(batch)``, in the world frame and unit of the input cameras.

    ``depth`` is meaningful where ``depth_valid``. ``rounds``: depths before the first round and after
    each (the last is ``depth_maps``). ``tokens``: of the encoder, only inside the model.
    """

    gaussians: Gaussians
    depth: Float[Tensor, "B V H W"]
    depth_valid: Bool[Tensor, "B V H W"]
    points: Points
    depth_maps: DepthMaps
    rounds: tuple[DepthMaps, ...] = ()
    tokens: Tokens | None = None


@dataclass(frozen=True)
class Rendering(TensorStruct):
    """Rendered Gaussians. ``depth`` is the expected z in metres, ``sum(w z) / max(sum(w), 1e-10)``."""

    image: Float[Tensor, "B T C h w"]
    alpha: Float[Tensor, "B T 1 h w"]
    depth: Float[Tensor, "B T 1 h w"]
