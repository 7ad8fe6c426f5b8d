"""Rendering of Gaussians: one function with three backends."""

import dataclasses
import importlib
import math
from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from ghgs_lit.config.options import Options, Positive
from ghgs_lit.errors import require, require_choice
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32, world_to_camera
from ghgs_lit.ops.rasterization.settings import RasterSettings
from ghgs_lit.rendering import gsplat_backend
from ghgs_lit.types import Cameras, Gaussians, Rendering

BACKENDS = ("auto", "gsplat", "cpu", "reference")
_OF_DEVICE = {"cuda": "gsplat", "cpu": "cpu"}
_MODULES = {
    "gsplat": "ghgs_lit.rendering.gsplat_backend",
    "cpu": "ghgs_lit.ops.rasterization.cpu",
    "reference": "ghgs_lit.rendering.reference",
}

Background = Tensor | float | Sequence[float]


def render(
    gaussians: Gaussians,
    cameras: Cameras,
    backend: str = "auto",
    background: Background = 0.0,
    near: float = 0.01,
    settings: RasterSettings | None = None,
) -> Rendering:
    """Render ``B`` sets of Gaussians from cameras [B, T].

    Differentiable in means, quaternions, scales, opacities, colours and background. Any image size and
    any number of Gaussians per element, including none. The image is defined by
    :class:`ghgs_lit.ops.rasterization.settings.RasterSettings`, as in 3D Gaussian Splatting (Kerbl et
    al., 2023).

    Args:
        gaussians: N Gaussians of all elements, ``splits`` of them in each; a zero quaternion is the
            identity; Gaussians with NaN in their geometry or opacity are not rendered.
        cameras: [B, T], without skew; all of one image size (h, w).
        backend: ``gsplat`` (CUDA), ``cpu`` (float32), ``reference`` (plain PyTorch in the
            dtype of the means, slow; also differentiable in the cameras) or ``auto``: gsplat
            on CUDA, else cpu.
        background: one number, one per channel, or a tensor that broadcasts with [B, T, 3, h, w].
        near: metres > 0 (see ``gaussians.metre``); Gaussians whose centre has ``z < near`` are
            culled.
        settings: constants of the image; None: those that the Gaussians were predicted for.

    Returns:
        Image [B, T, 3, h, w], alpha [B, T, 1, h, w] in [0, 1], and expected depth [B, T, 1, h, w]
        in the unit of the means, 0 where no Gaussian is visible.

    Raises:
        InputError: shapes, cameras or options are inconsistent.
        BackendUnavailable: gsplat cannot run on this machine.
    """
    settings = settings or make_settings(gaussians)
    require(0 < near < math.inf, "near", "a number of metres > 0", near)
    _check_inputs(gaussians, cameras)
    backend = resolve_backend(backend, gaussians.means.device)
    module = importlib.import_module(_MODULES[backend])
    metre = gaussians.metre
    with exact(gaussians.means.device.type):
        gaussians, cameras = _in_metres(*_around_cameras(_in_one_dtype(gaussians), cameras))
        cameras = cameras.to(gaussians.means.dtype) if backend == "reference" else cameras
        rendering = module.rasterize(gaussians, cameras, settings, float(near))
        if metre is not None:
            metre = metre.to(rendering.depth)[:, None, None, None, None]
            rendering = dataclasses.replace(rendering, depth=rendering.depth * metre)
        if isinstance(background, (int, float)) and background == 0:
            return rendering
        behind = (1 - rendering.alpha) * _background(background, rendering.image)
        return dataclasses.replace(rendering, image=rendering.image + behind)


def make_settings(gaussians: Gaussians, **settings) -> RasterSettings:
    """Settings that the Gaussians were predicted for: their ``low_pass`` and ``antialiased``, and
    further fields of :class:`RasterSettings` in ``settings``."""
    return RasterSettings(low_pass=gaussians.low_pass, antialiased=gaussians.antialiased, **settings)


def resolve_backend(backend: str, device: torch.device) -> str:
    """Backend for Gaussians on ``device``: ``gsplat``, ``cpu`` or ``reference``.

    Args:
        backend: one of :data:`BACKENDS`.
        device: device of the Gaussians.

    Raises:
        InputError: the backend is unknown or does not run on ``device``.
        BackendUnavailable: gsplat cannot run on this machine.
    """
    require_choice("renderer.backend", backend, BACKENDS)
    if backend == "auto":
        require(device.type in _OF_DEVICE, "renderer.backend=auto", "tensors on cuda or cpu", str(device))
        backend = _OF_DEVICE[device.type]
    if backend == "gsplat":
        gsplat_backend.load()
    fits = backend == "reference" or backend == _OF_DEVICE.get(device.type)
    require(fits, f"renderer.backend={backend}", "tensors on its device (cuda for gsplat)", str(device))
    return backend


class Renderer(Options):
    """:func:`render` with fixed options."""

    group = "renderer"
    backend: Literal["auto", "gsplat", "cpu", "reference"] = "auto"
    """gsplat (CUDA; needs the extra gpu), cpu (float32), reference (plain PyTorch, slow); auto: gsplat
    on CUDA, else cpu."""
    background: float | tuple[float, ...] = 0.0
    """Colour behind the Gaussians: one number or one for each channel."""
    near: Positive = 0.01
    """Near plane in metres: Gaussians whose centre is nearer are not rendered."""
    alpha_max: float = Field(0.999, gt=1 / 255, lt=1)
    """Upper limit of a Gaussian's alpha; gsplat applies it to opacities."""

    def __call__(
        self, gaussians: Gaussians, cameras: Cameras, background: Background | None = None
    ) -> Rendering:
        """:func:`render` with these options; ``background``, if given, overrides the configured one."""
        background = self.background if background is None else background
        settings = make_settings(gaussians, alpha_max=self.alpha_max)
        return render(gaussians, cameras, self.backend, background, self.near, settings)


def _check_inputs(gaussians: Gaussians, cameras: Cameras) -> None:
    """Raise InputError if shapes of Gaussians and cameras are inconsistent, or a camera has skew."""
    count = len(gaussians)
    shapes = {"means": (count, 3), "quaternions": (count, 4), "scales": (count, 3), "opacities": (count,)}
    shapes["colors"] = (count, 3)
    for name, shape in shapes.items():
        found = tuple(getattr(gaussians, name).shape)
        require(found == shape, f"gaussians.{name}", f"shape {shape}", found)
    adds_up = sum(gaussians.splits) == count and min(gaussians.splits, default=0) >= 0
    require(adds_up, "gaussians.splits", f"counts that add up to {count}", gaussians.splits)
    found = tuple(cameras.shape)
    expected = f"shape [{len(gaussians.splits)}, T], one row per batch element"
    require(len(found) == 2 and found[0] == len(gaussians.splits), "cameras", expected, found)
    size = (cameras.height, cameras.width)
    require(min(size) > 0, "cameras", "a positive image size", size)
    require(not cameras.has_skew, "cameras.intrinsics", "no skew: K[0, 1] = 0", "another value")


def _in_one_dtype(gaussians: Gaussians) -> Gaussians:
    """Convert Gaussians to float64 if any of their tensors is, else to float32."""
    fields = ("means", "quaternions", "scales", "opacities", "colors")
    tensors = {name: at_least_float32(getattr(gaussians, name)) for name in fields}
    is_double = any(tensor.dtype == torch.float64 for tensor in tensors.values())
    dtype = torch.float64 if is_double else torch.float32
    tensors = {name: t.to(dtype) for name, t in tensors.items()}
    return Gaussians(**tensors, splits=gaussians.splits, metre=gaussians.metre)


def _of_each(values: Tensor, gaussians: Gaussians) -> Tensor:
    """Repeat values of elements [B, ...] for each of their Gaussians."""
    if len(set(gaussians.splits)) == 1:  # avoids a copy to the GPU
        return values.repeat_interleave(gaussians.splits[0], dim=0)
    counts = torch.tensor(gaussians.splits).to(values.device, non_blocking=True)
    return values.repeat_interleave(counts, dim=0, output_size=len(gaussians))


def _around_cameras(gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Cameras]:
    """Move float64 scenes to each element's first camera, since backends compute in float32."""
    if gaussians.means.dtype != torch.float64 or 0 in cameras.shape:
        return gaussians, cameras
    origin = cameras[:, 0].to(torch.float64).centers.detach()
    extrinsics = cameras.extrinsics.double()
    moved = world_to_camera(origin[:, None].expand(*cameras.shape, 3), extrinsics)
    extrinsics = torch.cat((extrinsics[..., :3, :3], moved[..., None]), -1)
    extrinsics = torch.cat((extrinsics, cameras.extrinsics[..., 3:, :].double()), -2)
    means = gaussians.means - _of_each(origin, gaussians)
    return dataclasses.replace(gaussians, means=means), dataclasses.replace(cameras, extrinsics=extrinsics)


def _in_metres(gaussians: Gaussians, cameras: Cameras) -> tuple[Gaussians, Cameras]:
    """Scale Gaussians and cameras to metres; ``gaussians.metre`` is the length of a metre in the unit
    of each scene."""
    if gaussians.metre is None:
        return gaussians, cameras
    lengths = _of_each(gaussians.metre.to(gaussians.means), gaussians)[:, None]
    extrinsics = cameras.extrinsics.clone()
    extrinsics[..., :3, 3] = extrinsics[..., :3, 3] / gaussians.metre.to(extrinsics)[:, None, None]
    gaussians = dataclasses.replace(
        gaussians, means=gaussians.means / lengths, scales=gaussians.scales / lengths, metre=None
    )
    return gaussians, dataclasses.replace(cameras, extrinsics=extrinsics)


def _background(background: Background, color: Float[Tensor, "B T 3 h w"]) -> Tensor:
    """Convert a background to a tensor that broadcasts with the image ``color``.

    Raises:
        InputError: neither one number nor one per channel.
    """
    tensor = torch.as_tensor(background, dtype=color.dtype, device=color.device)
    if tensor.ndim == 1:
        require(len(tensor) in (1, 3), "renderer.background", "3 channels", len(tensor))
        return tensor[:, None, None]
    return tensor
