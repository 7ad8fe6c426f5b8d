"""Scenes and comparisons for tests and benchmarks of the renderer."""

import dataclasses
import math
import zlib
from unittest import mock

import numpy as np
import torch
from torch import Tensor

from ghgs_capture.export.page import _NARROW, _WIDE
from ghgs_lit.rendering import RasterSettings, reference, render
from ghgs_lit.types import Cameras, Gaussians, Rendering
from tests.helpers import cameras

FIELDS = ("means", "quaternions", "scales", "opacities", "colors")


def camera_ring(
    views: int, height: int, width: int, batch: int = 1, distance: float = 3.0, focal: float = 1.3
) -> Cameras:
    """Cameras [batch, views] on a circle around the y axis that look at the origin.

    Focal lengths of x and y differ and the principal point is off-centre, to detect swapped axes.

    Args:
        views, height, width, batch: number and image size of the cameras.
        distance: from the origin, in metres.
        focal: focal length along x as a fraction of the image's width.
    """
    focal, principal = (focal * width, 1.1 * focal * width), (0.5 * width + 0.3, 0.5 * height - 0.2)
    start = 180 - math.degrees(0.2) if views > 1 else 180.0
    place = {"radius": distance, "start": start, "spread": -360.0, "up": -1.0}
    return cameras.camera_ring(views, height, width, batch, focal, principal, **place)


def cloud(count: int, seed: int = 0, size: float = 0.05, splits: tuple | None = None) -> Gaussians:
    """Random Gaussians around the origin, of all shapes and orientations."""
    generator = torch.Generator().manual_seed(seed)
    return Gaussians(
        means=0.5 * torch.randn(count, 3, generator=generator),
        quaternions=torch.randn(count, 4, generator=generator),
        scales=size * torch.rand(count, 3, generator=generator) + 0.1 * size,
        opacities=torch.rand(count, generator=generator),
        colors=torch.rand(count, 3, generator=generator),
        splits=(count,) if splits is None else splits,
    )


def body(count: int, size: int, seed: int = 0) -> Gaussians:
    """Gaussians of about a pixel on an ellipsoid that covers a fifth of a ``size`` x ``size`` image."""
    generator = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    pixel = 3.0 / (1.3 * size)
    axes = torch.tensor([0.165, 0.36, 0.165]) * size * pixel
    return Gaussians(
        means=direction * axes + 0.002 * torch.randn(count, 3, generator=generator),
        quaternions=torch.randn(count, 4, generator=generator),
        scales=pixel * (0.2 + 0.4 * torch.rand(count, 3, generator=generator)),
        opacities=0.7 + 0.29 * torch.rand(count, generator=generator),
        colors=torch.rand(count, 3, generator=generator),
        splits=(count,),
    )


def few(**fields) -> Gaussians:
    """One isotropic Gaussian at the origin; ``fields`` replace values, more rows make more Gaussians."""
    values = {
        "means": torch.zeros(1, 3),
        "quaternions": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), 0.1),
        "opacities": torch.full((1,), 0.8),
        "colors": torch.tensor([[0.9, 0.5, 0.2]]),
    }
    values.update({name: torch.as_tensor(value, dtype=torch.float32) for name, value in fields.items()})
    count = max(len(value) for value in values.values())
    values = {name: value.expand(count, *value.shape[1:]).clone() for name, value in values.items()}
    return Gaussians(**values, splits=(count,))


def with_gradients(gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> Gaussians:
    """The same Gaussians as leaf tensors that require gradients."""
    fields = {name: getattr(gaussians, name).detach().to(dtype).requires_grad_() for name in FIELDS}
    return dataclasses.replace(gaussians, **fields)


def ambiguous(gaussians: Gaussians, views: Cameras, settings: RasterSettings, **options) -> Tensor:
    """Pixels [B, T, 1, h, w] where thresholds may decide differently in float32 and float64.

    They change if the thresholds move by slightly more than the rounding error of float32.
    """
    images = []
    double = (gaussians.to(torch.float64) if gaussians.means.dtype != torch.float64 else gaussians).detach()
    for sign in (-1, 1):
        moved = {"ALPHA_MIN": 1 + sign * 1e-5, "STOP": 1 + sign * 1e-3, "EXTENT": 1 + sign * 1e-6}
        moved = {name: getattr(reference, name) * factor for name, factor in moved.items()}
        with mock.patch.multiple(reference, **moved):
            images.append(render(double, views, "reference", settings=settings, **options))
    difference = (images[0].alpha - images[1].alpha).abs() + (images[0].image - images[1].image).abs().sum(
        2, True
    )
    return difference != 0


def relative_error(value: Tensor, truth: Tensor) -> float:
    """Relative L2 error; absolute where the truth is zero."""
    value, truth = value.detach().double(), truth.detach().double()
    return float((value - truth).norm() / (truth.norm() if truth.norm() > 0 else 1.0))


def differentiate(
    gaussians: Gaussians, views: Cameras, backend: str, dtype, weights: list[Tensor], **options
):
    """A rendering, and the gradients of the sum of (image, alpha, depth) times ``weights``."""
    gaussians = with_gradients(gaussians, dtype)
    rendering = render(gaussians, views, backend, **options)
    outputs = (rendering.image, rendering.alpha, rendering.depth)
    torch.autograd.backward([(o.double() * w).sum() for o, w in zip(outputs, weights, strict=True)])
    return rendering, {name: getattr(gaussians, name).grad for name in FIELDS}


def assert_cpu_matches_reference(
    gaussians: Gaussians,
    views: Cameras,
    settings: RasterSettings | None = None,
    image_budget: float = 2e-5,
    gradient_budget: float = 5e-5,
    ambiguous_budget: float = 0.01,
    **options,
) -> Rendering:
    """Assert that the CPU backend in float32 equals the reference in float64, forward and backward.

    Args:
        gaussians, views, settings, options: arguments of the rendering.
        image_budget, gradient_budget: largest relative L2 errors.
        ambiguous_budget: largest share of pixels that are ambiguous and therefore excluded.

    Returns:
        The CPU backend's rendering.
    """
    settings = settings or RasterSettings()
    unsure = ambiguous(gaussians, views, settings, **options)
    assert unsure.double().mean() <= ambiguous_budget
    generator = torch.Generator().manual_seed(7)
    shape = (*views.shape, 1, views.height, views.width)
    weights = [
        torch.randn((*shape[:2], c, *shape[3:]), generator=generator, dtype=torch.float64) * ~unsure
        for c in (3, 1, 1)
    ]
    truth, true_gradients = differentiate(
        gaussians, views, "reference", torch.float64, weights, settings=settings, **options
    )
    found, gradients = differentiate(
        gaussians, views, "cpu", torch.float32, weights, settings=settings, **options
    )
    for name in ("image", "alpha", "depth"):
        value, wanted = getattr(found, name), getattr(truth, name)
        assert torch.isfinite(value).all(), name
        assert relative_error(value * ~unsure, wanted * ~unsure) < image_budget, name
    for name in FIELDS:
        assert torch.isfinite(gradients[name]).all(), name
        assert relative_error(gradients[name], true_gradients[name]) < gradient_budget, name
    return found


def unpack(data: bytes, pixel, center, steps, like: Gaussians) -> Gaussians:
    """The Gaussians of ``pack``, as the page reads them."""
    planes = np.frombuffer(zlib.decompress(data), np.uint8).reshape(4 * _WIDE + _NARROW, -1)
    wide = np.ascontiguousarray(planes[: 4 * _WIDE].T).view("<u4").astype(np.int64)
    centers = torch.from_numpy((wide >> 1 ^ -(wide & 1)).cumsum(0))
    narrow = planes[4 * _WIDE :].T.astype(np.int64).cumsum(0)
    narrow[:, [3, 5]] += narrow[:, [4]]
    scales, colors, rotations = (torch.from_numpy(part) for part in np.split(narrow, [3, 7], axis=1))
    turned = signed(rotations) / steps["rotation"]
    square = turned.square().sum(1, keepdim=True)
    values = {
        "means": center + centers * (pixel / steps["center"]),
        "scales": pixel * (signed(scales) / steps["scale"]).exp(),
        "quaternions": torch.cat([1 - square, 2 * turned], dim=1) / (1 + square),
        "colors": (colors[:, :3] & 255) / 255,
        "opacities": (colors[:, 3] & 255) / steps["opacity"],
    }
    values = {name: value.float() for name, value in values.items()}
    return dataclasses.replace(like, **values, image=None, pixel=None, splits=(len(centers),))


def signed(numbers):
    """Numbers modulo 256, from -128 to 127."""
    return (numbers + 128 & 255) - 128
