"""Measure the CPU rasterizer: ``python benchmarks/rasterizer.py [--quick] [--json FILE] [--pictures DIR]``.

The scene is a closed body of flat splats that covers 19 % of the frame; the sigma of a splat is about the
distance to the next one. Runs are interleaved, so that other load on the machine affects all alike; ratios
are those of minima.
"""

import argparse
import json
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))
import peers
import rasterizer_checks as checks

from ghgs_lit.rendering import render
from ghgs_lit.types import Cameras, Gaussians

COVERED = 0.19


def scene(count: int, size: int, seed: int = 0) -> tuple[Gaussians, Cameras]:
    """Splats that require gradients on an ellipsoid, and one camera."""
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


def ours(gaussians: Gaussians, cameras: Cameras) -> Tensor:
    return render(gaussians, cameras, "cpu").image.view(3, cameras.height, cameras.width)


CONTENDERS: dict[str, Callable[[Gaussians, Cameras], Tensor]] = {
    "ours": ours,
    "box": lambda gaussians, cameras: peers.render_box(gaussians, cameras[0, 0]),
    "torch": lambda gaussians, cameras: peers.render_torch(gaussians, cameras[0, 0]),
}


def time_once(name: str, threads: int, gaussians: Gaussians, cameras: Cameras, upstream: Tensor):
    """Seconds of one forward and one backward pass."""
    torch.set_num_threads(threads)
    for field in checks.FIELDS:
        getattr(gaussians, field).grad = None
    start = time.perf_counter()
    image = CONTENDERS[name](gaussians, cameras)
    middle = time.perf_counter()
    image.backward(upstream)
    return middle - start, time.perf_counter() - middle


def measure(count: int, size: int, repeats: dict[str, int]) -> dict[tuple[str, int], dict]:
    """Minima and medians in ms of every contender and number of threads."""
    gaussians, cameras = scene(count, size)
    upstream = torch.randn(3, size, size, generator=torch.Generator().manual_seed(1))
    runs = [("ours", 1), ("ours", 2), ("box", 1), ("torch", 2)]
    times: dict[tuple[str, int], list] = {run: [] for run in runs if repeats[run[0]] > 0}
    for name, threads in times:
        if name != "torch":
            time_once(name, threads, gaussians, cameras, upstream)
    for turn in range(max(repeats.values())):
        for run, found in times.items():
            if turn < repeats[run[0]]:
                found.append(time_once(*run, gaussians, cameras, upstream))
    return {run: _summary(found) for run, found in times.items()}


def _summary(found: list[tuple[float, float]]) -> dict:
    forward, backward = ([1e3 * value for value in values] for values in zip(*found, strict=True))
    totals = [a + b for a, b in zip(forward, backward, strict=True)]
    return {
        "forward": min(forward),
        "backward": min(backward),
        "total": min(totals),
        "median": statistics.median(totals),
    }


def repeats(count: int, quick: bool) -> dict[str, int]:
    """Number of runs of each contender; none of plain PyTorch for 200 000 splats:
    it takes minutes."""
    slow = 0 if count > 50_000 else 1 if quick else 3
    return {"ours": 12 if quick else 40, "box": 5 if quick else 12, "torch": slow}


def rows_of(count: int, size: int, found: dict[tuple[str, int], dict]) -> list[dict]:
    """One row for each number of threads and each peer."""
    rows = []
    for threads in (1, 2):
        own = found["ours", threads]
        for (peer, peer_threads), other in found.items():
            if peer == "ours":
                continue
            rows.append({
                "splats": count, "size": size, "threads": threads, "peer": peer, "peer_threads": peer_threads,
                "forward_ms": own["forward"], "backward_ms": own["backward"], "median_ms": own["median"],
                "peer_forward_ms": other["forward"], "peer_backward_ms": other["backward"],
                "ratio": other["total"] / own["total"],
            })  # fmt: skip
    return rows


def print_times(sizes: tuple[int, ...], quick: bool) -> list[dict]:
    """Measure and print the table of times; returns its rows."""
    rows = []
    print(
        "| splats | size | threads | forward ms | backward ms | median ms | peer (threads) | peer ms ", end=""
    )
    print(f"| peer / ours |\n{'|---' * 9}|")
    for size in sizes:
        for count in (5_000, 50_000, 200_000):
            found = measure(count, size, repeats(count, quick))
            for row in rows_of(count, size, found):
                peer_ms = row["peer_forward_ms"] + row["peer_backward_ms"]
                numbers = (row["forward_ms"], row["backward_ms"], row["median_ms"])
                cells = [f"{count}", f"{size}", f"{row['threads']}", *(f"{number:.2f}" for number in numbers)]
                cells += [f"{row['peer']} ({row['peer_threads']})", f"{peer_ms:.1f}", f"{row['ratio']:.1f}"]
                print(f"| {' | '.join(cells)} |", flush=True)
            rows += rows_of(count, size, found)
    return rows


def print_checks() -> dict:
    """Measure and print errors against float64 and the seconds of the first use; returns both."""
    found = {
        "body": checks.errors(*scene(1_500, 64)),
        "person": checks.errors(*checks.person(3_000, 64, 32)),
    }
    print("\n| scene | image | alpha | gradient | ambiguous pixels, left out |\n|---|---|---|---|---|")
    for name, errors in found.items():
        cells = [f"{errors[key]:.1e}" for key in ("image", "alpha", "gradient")]
        print(f"| {name} | {' | '.join(cells)} | {errors['ambiguous']:.2%} |")
    compiled, cached = checks.first_use()
    print(f"\nFirst use of a new process: {compiled:.1f} s; with cached machine code: {cached:.1f} s")
    return {"errors": found, "first_use_s": compiled, "cached_use_s": cached}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--quick", action="store_true", help="512 x 512 only, fewer runs; under three minutes"
    )
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--pictures", type=Path, help="only draw a person by all backends, into this folder")
    options = parser.parse_args()
    if options.pictures:
        drawers = {"cpu": CONTENDERS["ours"], "box": CONTENDERS["box"], "torch": CONTENDERS["torch"]}
        print(checks.pictures(options.pictures, drawers))
        return
    rows = print_times((512,) if options.quick else (256, 512, 1024), options.quick)
    found = print_checks()
    if options.json:
        options.json.write_text(json.dumps({"rows": rows, **found}, indent=1) + "\n")
        print(f"rows: {options.json}")


if __name__ == "__main__":
    main()
