"""The peak memory of a prediction and of a training step on this machine, for a configuration.

    python benchmarks/memory.py --size 140 encoder=vggt_nano model=hull
    python benchmarks/memory.py --size 518 --device cuda encoder=vggt_1b model=paper renderer=auto

Measured is what tensors take; on a CPU in a fresh process, in which the C library gives freed
memory back at once.
"""

import argparse
import dataclasses
import os
import subprocess
import sys

import torch

from ghgs_lit.config import run_of
from ghgs_lit.config.run import Run
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch, random_model
from ghgs_lit.diagnostics.benchmark.stages import TOTAL, PeakProbe
from ghgs_lit.execution import Predictor
from ghgs_lit.method.model import GHGS
from ghgs_lit.types import Batch

#: Blocks above this size go back to the system when they are freed.
_AT_ONCE = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}


def measured_prediction(run: Run, batch: Batch, device: torch.device) -> int:
    """Peak bytes of a second prediction in addition to the weights."""
    model = Predictor(random_model(run.plain).to(device))
    batch = dataclasses.replace(batch, targets=None).to(device)
    with torch.no_grad():
        model(batch)
        probe = PeakProbe(device)
        probe.begin(TOTAL)
        model(batch)
        probe.end(TOTAL)
    return probe.peaks[TOTAL]


def measured_training(run: Run, batch: Batch, device: torch.device) -> int:
    """Peak bytes of a second training step in addition to weights and moments."""
    model, renderer = GHGS.from_config(run.plain).to(device), run.renderer.build()
    losses, optimizer = run.loss.build(), run.optimizer.optimizer(model)
    batch = dataclasses.replace(
        batch, depths=2.0 * batch.masks, body_vertices=[torch.rand(10475, 3) for _ in batch.images]
    ).to(device)
    for _ in range(2):
        optimizer.zero_grad()
        probe = PeakProbe(device)
        probe.begin(TOTAL)
        prediction = Predictor(model)(batch)
        total = losses(prediction, renderer(prediction.gaussians, batch.targets.cameras), batch)[0]
        del prediction
        total.backward()
        probe.end(TOTAL)
        optimizer.step()
        del total
    return probe.peaks[TOTAL]


def measured(
    overrides: list[str], size: int, views: int, batch: int, device: torch.device, training: bool
) -> dict[str, int]:
    """Peak bytes, weights and moments included, and theirs."""
    run = run_of("train", overrides)
    with torch.device("meta"):
        model = GHGS.from_config(run.plain)
    held = sum(
        p.numel() * p.element_size() * (3 if training and p.requires_grad else 1) for p in model.parameters()
    )
    measure = measured_training if training else measured_prediction
    return {"peak": held + measure(run, ellipsoid_batch(0.15, views, size, batch), device), "held": held}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("overrides", nargs="*", help="of the configuration, such as encoder=vggt_small")
    parser.add_argument("--size", type=int, default=140)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    options = parser.parse_args()
    if _AT_ONCE.items() - os.environ.items():
        sys.exit(subprocess.call([sys.executable, *sys.argv], env={**os.environ, **_AT_ONCE}))
    torch.set_num_threads(1)
    for what in ("prediction", "training"):
        scene = options.size, options.views, options.batch, options.device
        found = measured(options.overrides, *scene, what == "training")
        megabytes = ", ".join(f"{name} {value / 1e6:.1f} MB" for name, value in found.items())
        print(f"{what}: {megabytes}", flush=True)


if __name__ == "__main__":
    main()
