"""Further measurements of the CPU rasterizer: its errors, its first use, and pictures of a person."""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
from torch import Tensor

from ghgs_lit.rendering import RasterSettings, render
from ghgs_lit.types import Cameras, Gaussians
from ghgs_people.figures import TexturedMesh, generate
from tests.helpers.splats import FIELDS, ambiguous, differentiate, relative_error

# Factor by which differences are magnified in pictures.
AMPLIFIED = 1e6

_FIRST_USE = """
import time
import torch
from ghgs_lit.rendering import render
from ghgs_lit.types import Cameras, Gaussians
one = torch.ones(1, 1)
gaussians = Gaussians(one.expand(1, 3).clone().requires_grad_(), one.expand(1, 4), one.expand(1, 3), one[0],
                      one.expand(1, 3), splits=(1,))
views = Cameras(100 * torch.eye(3)[None, None], torch.eye(4)[None, None], 64, 64)
start = time.perf_counter()
render(gaussians, views, "cpu").image.sum().backward()
print(time.perf_counter() - start)
"""


def first_use() -> tuple[float, float]:
    """Seconds of the first forward and backward pass of a new process: without a cache,
    and with it."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        command = [sys.executable, "-c", _FIRST_USE]
        runs = [subprocess.run(command, env=environment, capture_output=True, check=True) for _ in range(2)]
    return float(runs[0].stdout), float(runs[1].stdout)


def errors(gaussians: Gaussians, cameras: Cameras) -> dict[str, float]:
    """Relative L2 errors of the CPU backend against the reference in float64,
    without ambiguous pixels."""
    gaussians = gaussians.detach()
    unsure = ambiguous(gaussians, cameras, RasterSettings())
    generator = torch.Generator().manual_seed(1)
    size = (cameras.height, cameras.width)
    weights = [torch.randn(*cameras.shape, c, *size, generator=generator).double() * ~unsure for c in (3, 1)]
    weights.append(torch.zeros_like(weights[1]))  # depth is left out
    truth, slopes = differentiate(gaussians, cameras, "reference", torch.float64, weights)
    found, others = differentiate(gaussians, cameras, "cpu", torch.float32, weights)
    return {
        "image": relative_error(found.image * ~unsure, truth.image * ~unsure),
        "alpha": relative_error(found.alpha * ~unsure, truth.alpha * ~unsure),
        "gradient": max(relative_error(others[name], slopes[name]) for name in FIELDS),
        "ambiguous": float(unsure.double().mean()),
    }


def person(count: int, height: int, width: int, index: int = 0) -> tuple[Gaussians, Cameras]:
    """About ``count`` flat splats on a generated person, seen from the front."""
    generator = np.random.default_rng(index)
    parts = generate(seed=0, index=index).parts
    areas = [_areas(part) for part in parts]
    total = sum(area.sum() for area in areas)
    samples = [
        _sample(part, area, int(count * area.sum() / total), generator)
        for part, area in zip(parts, areas, strict=True)
    ]
    points, normals, colors = (
        torch.from_numpy(np.concatenate(s)).float() for s in zip(*samples, strict=True)
    )
    spacing = float(np.sqrt(total / count))
    # The rotation from z to the normal; 1e-6 avoids the zero quaternion for a normal of -z.
    quaternions = torch.stack(
        (1 + normals[:, 2] + 1e-6, -normals[:, 1], normals[:, 0], torch.zeros(len(points))), dim=-1
    )
    gaussians = Gaussians(
        means=points,
        quaternions=quaternions,
        scales=spacing * torch.tensor([0.6, 0.6, 0.1]).expand(len(points), 3),
        opacities=torch.full((len(points),), 0.9),
        colors=colors,
        splits=(len(points),),
    )
    focal = 1.5 * height
    intrinsics = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    extrinsics = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
    extrinsics[1, 3], extrinsics[2, 3] = 0.9, 3.0
    return gaussians, Cameras(intrinsics[None, None], extrinsics[None, None], height, width)


def _areas(part: TexturedMesh) -> np.ndarray:
    a, b, c = (part.vertices[part.faces[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _sample(part: TexturedMesh, areas: np.ndarray, count: int, generator) -> tuple[np.ndarray, ...]:
    """Points, normals and colours at ``count`` random places of a mesh."""
    chosen = generator.choice(len(areas), count, p=areas / areas.sum())
    weights = generator.dirichlet((1, 1, 1), count)[..., None]
    corners = part.vertices[part.faces[chosen]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    u, v = (part.uv[part.faces[chosen]] * weights).sum(1).T
    height, width = part.texture.shape[:2]
    rows = np.clip(((1 - v) * height).astype(int), 0, height - 1)
    texels = part.texture[rows, np.clip((u * width).astype(int), 0, width - 1)] / 255
    points = (corners * weights).sum(1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return points, normals, texels


@torch.no_grad()
def pictures(folder: Path, backends: dict[str, Callable[[Gaussians, Cameras], Tensor]]) -> Path:
    """A person drawn by every backend (images [3, h, w]),
    and below each its difference from the reference.

    The reference is drawn in float64; differences are magnified ``AMPLIFIED`` times.
    """
    folder.mkdir(parents=True, exist_ok=True)
    gaussians, cameras = person(15_000, 256, 128)
    start = time.perf_counter()
    truth = render(gaussians.to(torch.float64), cameras, "reference").image[0, 0]
    print(f"reference: {time.perf_counter() - start:.1f} s", flush=True)
    columns = [torch.cat((truth, torch.zeros_like(truth)), dim=1)]
    for name, draw in backends.items():
        image = draw(gaussians, cameras).double()
        difference = (image - truth).abs()
        worst, mean = float(difference.max()), float(difference.mean())
        print(f"{name}: differs from the reference by {worst:.1e} at most, {mean:.1e} on average", flush=True)
        columns.append(torch.cat((image, difference * AMPLIFIED), dim=1))
    picture = (torch.cat(columns, dim=2).clamp(0, 1) * 255).round().byte().permute(1, 2, 0)
    path = folder / "person.png"
    imageio.imwrite(path, picture.numpy())
    return path
