"""The device's renderer against the reference in float64: images, gradients, thresholds."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from ghgs_lit.diagnostics.benchmark.error import ATTRIBUTES
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.diagnostics.doctor.selfcheck.outcome import SKIPPED, Outcome, compared
from ghgs_lit.errors import InputError
from ghgs_lit.rendering import RasterSettings, render
from ghgs_lit.rendering.api import resolve_backend
from ghgs_lit.types import Cameras, Gaussians

#: Largest errors of images and of gradients. Rounding to float32 gives 1e-6 and 1e-5 on a CPU; a splat that
#: one of both cuts off at 1/255, at its border of a tile or in another order gives more than 1e-3.
IMAGE_LIMIT, GRADIENT_LIMIT = 1e-4, 1e-3
_SIZE = 48
_PARTS = ("image", "alpha", "depth")


def renderer(config: Mapping[str, Any], device: torch.device) -> Iterator[Outcome]:
    """Of random splats with and without antialiasing, and of splats around each threshold."""
    backend = config["renderer"]["backend"]
    try:
        backend = resolve_backend(backend, device)
    except InputError as error:
        yield Outcome(f"renderer {backend}", SKIPPED, str(error))
        return
    cameras = ellipsoid_batch(0.15, 2, _SIZE, 2).cameras
    for name, splats, settings in (
        ("random splats", random_splats(), RasterSettings()),
        ("antialiased", random_splats(), RasterSettings(antialiased=True)),
        ("thresholds", splats_at_thresholds(cameras), RasterSettings()),
    ):
        found = _rendered(splats, cameras, settings, backend, device, torch.float32)
        expected = _rendered(splats, cameras, settings, "reference", torch.device("cpu"), torch.float64)
        for part, value in expected.items():
            limit = IMAGE_LIMIT if part in _PARTS else GRADIENT_LIMIT
            yield compared(f"renderer {backend}, {name}: {part}", found[part], value, limit)


def random_splats(counts: tuple[int, int] = (150, 90)) -> Gaussians:
    """Of two elements with different numbers of splats, about as large as a person."""
    n, g = sum(counts), torch.Generator().manual_seed(0)
    return Gaussians(
        means=torch.randn(n, 3, generator=g) * torch.tensor([0.2, 0.5, 0.2]),
        quaternions=torch.randn(n, 4, generator=g),
        scales=0.01 + 0.05 * torch.rand(n, 3, generator=g),
        opacities=0.1 + 0.8 * torch.rand(n, generator=g),
        colors=torch.rand(n, 3, generator=g),
        splits=counts,
    )


def splats_at_thresholds(cameras: Cameras) -> Gaussians:
    """Before the first camera of each element: what each constant of the image cuts off, and what it leaves.

    Opacities just below and above 1/255; ten opaque splats behind one another, whose light ends before the
    last; a bright one nearer than ``near``, one behind the camera.
    """
    depths = [2.0, 2.0, *(2.2 + 0.05 * i for i in range(10)), 0.005, -1.0]
    opacities = [0.9 / 255, 1.2 / 255, *[0.9, 1.0] * 5, 1.0, 1.0]
    right = [-0.4, 0.4, *[0.02 * i for i in range(10)], 0.0, 0.0]
    n = len(depths)
    place = torch.tensor([right, [0.01] * n, depths]).T
    means = [(place - c.extrinsics[:3, 3]) @ c.extrinsics[:3, :3] for c in (cameras[e, 0] for e in range(2))]
    colors = torch.rand(2 * n, 3, generator=torch.Generator().manual_seed(0))
    return Gaussians(
        means=torch.cat(means),
        quaternions=torch.tensor([[0.9, 0.1, -0.3, 0.2]]).repeat(2 * n, 1),
        # Of three lengths: the direction of a ball has no gradient.
        scales=torch.tensor([[0.06, 0.1, 0.14]]).repeat(2 * n, 1),
        opacities=torch.tensor(opacities * 2),
        colors=colors,
        splits=(n, n),
    )


def _rendered(
    splats: Gaussians,
    cameras: Cameras,
    settings: RasterSettings,
    backend: str,
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    """Image, alpha, depth, and the gradients of a score of them."""
    leaves = {n: getattr(splats, n).to(device, dtype, copy=True).requires_grad_() for n in ATTRIBUTES}
    found = render(Gaussians(**leaves, splits=splats.splits), cameras.to(device), backend, settings=settings)
    (found.image.square().sum() + found.alpha.square().sum() + found.depth.square().sum()).backward()
    parts = {name: getattr(found, name) for name in _PARTS}
    return parts | {f"gradient of {name}": leaf.grad for name, leaf in leaves.items()}
