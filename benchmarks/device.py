"""GPU work by stage: calls, kernel launches (calls other than views), device-to-host synchronisations.

Counted on the pretend device of the tests, without a GPU. A GPU idles between many small calls, and
where the host waits for a value. Copying a list to the device synchronises, too.

    python benchmarks/device.py                          # vggt_nano, two elements of four views of 140 x 140
    python benchmarks/device.py --lines model=paper      # lines that synchronise; with overrides of
    `ghgs train`

gsplat's kernels for projection and rasterization are excluded: a stand-in renders nothing.
"""

import argparse
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))

from ghgs_lit.config import run_of
from ghgs_lit.diagnostics.benchmark.measure import OTHER, TOTAL, top_level, watch_model
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.execution import Predictor
from ghgs_lit.losses import Losses, LossWeights
from ghgs_lit.method.model import GHGS
from ghgs_lit.rendering import api, gsplat_backend
from ghgs_lit.runtime.watching import Watcher
from ghgs_lit.training import Optimization
from ghgs_lit.types import Batch
from tests.helpers.pretend_device import DEVICE, Log, pretend_device

Counts = dict[str, tuple[int, int, int]]


class CountingProbe(Watcher):
    """Calls, launches and synchronisations of each stage."""

    def __init__(self, log: Log):
        self.log = log
        self.counts: Counts = {}
        self._open: list[tuple[int, int, int]] = []

    def begin(self, stage: str) -> None:
        self._open.append(self._so_far())

    def end(self, stage: str, result: Any = None) -> None:
        numbers = zip(self.counts.get(stage, (0, 0, 0)), self._so_far(), self._open.pop(), strict=True)
        self.counts[stage] = tuple(old + now - before for old, now, before in numbers)

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        self.begin(stage)
        yield
        self.end(stage)

    def _so_far(self) -> tuple[int, int, int]:
        return self.log.calls.total(), self.log.launches, self.log.waits.total()


def forward(predictor: Predictor, batch: Batch, log: Log) -> Counts:
    """Counts of one prediction without gradients."""
    probe = CountingProbe(log)
    with torch.no_grad(), watch_model(predictor.model, probe), probe.of(TOTAL):
        predictor(batch)
    stages = [probe.counts[name] for name in top_level(probe.counts)]
    rest = (sum(numbers) for numbers in zip(*stages, strict=True))
    probe.counts[OTHER] = tuple(a - b for a, b in zip(probe.counts[TOTAL], rest, strict=True))
    return probe.counts


class Gsplat:
    """A stand-in for gsplat that renders nothing: every splat touches a tile."""

    __version__ = "1.5.3"

    @staticmethod
    def fully_fused_projection(
        means: Tensor, scales: Tensor, quats: Tensor, viewmats: Tensor, calc_compensations: bool, **options
    ) -> tuple[Tensor | None, ...]:
        values = torch.cat((means, scales, quats), -1)[:, None].expand(-1, viewmats.shape[1], -1, -1)
        radii = values.new_ones(*values.shape[:-1], 2, dtype=torch.int32)
        compensations = values[..., 0] if calc_compensations else None
        return radii, values[..., :2].contiguous(), values[..., 2], values[..., 3:6], compensations

    @staticmethod
    def rasterization(means: Tensor, colors: Tensor, width: int, height: int, **options: Any) -> tuple:
        seen = means.sum() + colors.sum()
        seen.item()  # the number of intersections
        views = options["viewmats"].shape[:2]
        values = means.new_zeros(*views, height, width, colors.shape[-1] + 1) + 0 * seen
        return values, values[..., :1], {}

    @staticmethod
    def rasterize_to_pixels(
        means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int,
        *lists: Any, **options: Any,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        seen = means2d.sum() + conics.sum() + colors.sum() + opacities.sum()
        values = means2d.new_zeros(*means2d.shape[:2], height, width, colors.shape[-1]) + 0 * seen
        return values, values[..., :1]


@contextmanager
def render_nothing() -> Iterator[None]:
    """Render through the gsplat backend with a stand-in for gsplat."""
    with (
        mock.patch.object(api, "resolve_backend", return_value="gsplat"),
        mock.patch.object(gsplat_backend, "load", return_value=Gsplat),
    ):
        yield


def second_step(model: GHGS, options: Optimization, batch: Batch, log: Log) -> Counts:
    """Counts of a training step without the creation of the optimizer's state."""
    optimizer = options.optimizer(model)
    step(model, options, optimizer, batch, log)
    optimizer.zero_grad()
    return step(model, options, optimizer, batch, log)


def step(
    model: GHGS, options: Optimization, optimizer: torch.optim.Optimizer, batch: Batch, log: Log
) -> Counts:
    losses, probe = (
        Losses(weights=LossWeights(render_l1=0.8, render_ssim=0, chamfer=0, depth=0.2)),
        CountingProbe(log),
    )
    with probe.of("forward"):
        prediction = Predictor(model)(batch)
    with probe.of("render"):
        rendering = api.render(prediction.gaussians, batch.targets.cameras)
    with probe.of("loss"):
        total = losses(prediction, rendering, batch)[0]
    with probe.of("backward"):
        total.backward()
    with probe.of("optimizer"):
        torch.nn.utils.clip_grad_norm_(model.parameters(), options.clip, foreach=True)
        optimizer.step()
    return probe.counts


def show(title: str, found: list[Counts], sizes: list[int]) -> None:
    heads = "".join(f"{f'batch {size}':>26}" for size in sizes)
    print(f"\n{title:24}{heads}\n{'':24}" + f"{'calls':>9}{'launches':>10}{'waits':>7}" * len(sizes))
    for name in found[0]:
        print(f"{name:24}" + "".join("{:9}{:10}{:7}".format(*counts[name]) for counts in found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("overrides", nargs="*", help="of the configuration, such as model=paper skip=fast")
    parser.add_argument("--batches", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--size", type=int, default=140)
    parser.add_argument("--lines", action="store_true", help="name the lines that wait")
    options = parser.parse_args()
    run = run_of("train", ["encoder=vggt_nano", *options.overrides])
    predictions, steps = [], []
    with pretend_device(options.lines) as log, render_nothing():
        model = GHGS.from_config(run.plain).to(DEVICE)
        for size in options.batches:
            batch = ellipsoid_batch(0.15, options.views, options.size, size)
            depths = 2.0 * batch.masks
            batch = Batch(batch.images, batch.masks, batch.cameras, batch.targets, depths=depths).to(DEVICE)
            log.clear()
            predictions.append(forward(Predictor(model), batch, log))
            if options.lines:
                for (reason, line), count in log.waits.most_common():
                    print(f"batch {size}: {count:4} {reason:20} {line}")
            steps.append(second_step(model, run.optimizer, batch, log))
    show("prediction", predictions, options.batches)
    show("training step", steps, options.batches)


if __name__ == "__main__":
    main()
