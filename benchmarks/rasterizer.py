"""Measure the CPU rasterizer: ``python benchmarks/rasterizer.py``.

The scene is a closed surface of flat splats that covers 19 % of a frame of 512 x 512 pixels; the
sigma of a splat is about its distance to the next one. Prints minima over interleaved runs.
"""

import math
import sys
import time
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))

from ghgs_lit.rendering import render
from ghgs_lit.types import Cameras, Gaussians

COVERED = 0.19
SIZE = 512
COUNTS = (5_000, 50_000, 200_000)
THREADS = (1, 2)
REPEATS = 12


def scene(count: int, size: int, seed: int = 0) -> tuple[Gaussians, Cameras]:
    """Splats on an ellipsoid that require gradients, and one camera."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    focal, distance = 1.4 * size, 3.0
    pixel = distance / focal
    half = math.sqrt(COVERED * size**2 / math.pi / 2.2)
    axes = torch.tensor([half, 2.2 * half, half]) * pixel
    # Knud Thomsen's formula for the surface of an ellipsoid.
    products = torch.stack((axes[0] * axes[1], axes[0] * axes[2], axes[1] * axes[2])) ** 1.6075
    surface = 4 * math.pi * float(products.mean()) ** (1 / 1.6075)
    spacing = math.sqrt(surface / count)
    scales = spacing * (0.6 + 0.8 * torch.rand(count, 3, generator=generator))
    scales[:, 2] *= 0.1
    # The rotation from z to the normal of the unit sphere, which is close to the ellipsoid's.
    quaternions = torch.stack((1 + normal[:, 2], -normal[:, 1], normal[:, 0], torch.zeros(count)), dim=-1)
    values = {
        "means": normal * axes,
        "quaternions": quaternions,
        "scales": scales,
        "opacities": 0.6 + 0.39 * torch.rand(count, generator=generator),
        "colors": torch.rand(count, 3, generator=generator),
    }
    intrinsics = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    extrinsics = torch.eye(4)
    extrinsics[2, 3] = distance
    gaussians = Gaussians(**{name: value.requires_grad_() for name, value in values.items()}, splits=(count,))
    return gaussians, Cameras(intrinsics[None, None], extrinsics[None, None], size, size)


def seconds(gaussians: Gaussians, cameras: Cameras, upstream: Tensor) -> tuple[float, float]:
    """Seconds of one forward and one backward pass."""
    start = time.perf_counter()
    image = render(gaussians, cameras, "cpu").image.view_as(upstream)
    middle = time.perf_counter()
    image.backward(upstream)
    return middle - start, time.perf_counter() - middle


def main() -> None:
    print("| splats | threads | forward ms | backward ms |\n|---|---|---|---|")
    upstream = torch.randn(3, SIZE, SIZE, generator=torch.Generator().manual_seed(1))
    for count in COUNTS:
        gaussians, cameras = scene(count, SIZE)
        seconds(gaussians, cameras, upstream)  # compilation
        times: dict[int, list[tuple[float, float]]] = {threads: [] for threads in THREADS}
        for _ in range(REPEATS):
            for threads, found in times.items():
                torch.set_num_threads(threads)
                found.append(seconds(gaussians, cameras, upstream))
        for threads, found in times.items():
            forward, backward = (1e3 * min(each) for each in zip(*found, strict=True))
            print(f"| {count} | {threads} | {forward:.2f} | {backward:.2f} |", flush=True)


if __name__ == "__main__":
    main()
