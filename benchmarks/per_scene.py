"""What per-scene 3D Gaussian splatting reaches after how long: PSNR of the inputs and of both targets.

    python benchmarks/per_scene.py data=scans data.root=rendered
    python benchmarks/per_scene.py data=scans data.root=rendered --people 2 --seconds 1 5

Further arguments are those of `ghgs evaluate`. Seconds are those that a processor spends on the optimiser,
in one thread, without the start; means over the first people of the split.
"""

import argparse
import time
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from ghgs_lit.cli.inputs import build_data, build_renderer
from ghgs_lit.config import compose, resolve
from ghgs_lit.evaluation.baselines.splats import PerScene
from ghgs_lit.evaluation.protocols import target_protocols
from ghgs_lit.geometry.masks import on_black
from ghgs_lit.metrics import psnr
from ghgs_lit.types import Batch, Gaussians

#: More steps than there is time for.
MANY = 10**9


def reached(method: PerScene, batch: Batch, seconds: Sequence[float]) -> Iterator[tuple[int, Gaussians]]:
    """Steps and Gaussians after each of ``seconds``, in increasing order."""
    left, spent, steps = list(seconds), 0.0, 0
    states = method.fitting.states(method.begin(batch), batch)
    next(states)
    while left:
        begin = time.process_time()
        gaussians = next(states)
        spent, steps = spent + time.process_time() - begin, steps + 1
        while left and spent >= left[0]:
            yield steps, gaussians
            left.pop(0)


def numbers(method: PerScene, gaussians: Gaussians, batch: Batch) -> list[float]:
    """PSNR of the inputs, and of each target."""

    def of(cameras, images: Tensor) -> Tensor:
        return psnr(method.renderer(gaussians, cameras).image[0].clamp(0, 1), images[0])

    inputs = of(batch.cameras, on_black(batch)).mean()
    return [float(inputs), *of(batch.targets.cameras, batch.targets.images).tolist()]


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("overrides", nargs="+", metavar="key=value")
    parser.add_argument("--people", type=int, default=4)
    parser.add_argument("--seconds", type=float, nargs="+", default=[1, 5, 15, 30, 60, 120])
    options = parser.parse_intermixed_args()
    torch.set_num_threads(1)
    config = resolve(compose("evaluate", options.overrides))
    renderer = build_renderer(config, torch.device("cpu"))
    method = PerScene(renderer, MANY)
    data, targets = build_data(config), target_protocols(config)
    split, views = config["evaluation"]["split"], config["evaluation"]["views"][0]
    data.prepare_data([split])
    found: dict[float, list[list[float]]] = {seconds: [] for seconds in sorted(options.seconds)}
    for subject in list(data.subjects(split))[: options.people]:
        batch = data.evaluation_batch(subject, split, views, list(targets.values()))
        for seconds, (steps, gaussians) in zip(found, reached(method, batch, list(found)), strict=True):
            found[seconds].append([steps, *numbers(method, gaussians, batch)])
    print(f"| {' | '.join(('seconds', 'steps', 'inputs', *targets))} |\n" + "|---" * (3 + len(targets)) + "|")
    for seconds, rows in found.items():
        steps, *values = torch.tensor(rows).mean(0).tolist()
        print(f"| {seconds:g} | {steps:.0f} | {' | '.join(f'{value:.2f}' for value in values)} |")


if __name__ == "__main__":
    main()
