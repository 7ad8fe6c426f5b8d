"""The doctor's estimates of memory beside measured peaks on this machine, for a configuration.

    python benchmarks/memory.py --size 140 encoder=vggt_nano model=hull
    python benchmarks/memory.py --size 518 --device cuda encoder=vggt_1b model=paper renderer=auto

Measured is what tensors take; on a CPU in a fresh process, in which the C library gives freed memory back at
once.
"""

import argparse
import dataclasses
import json
import os
import subprocess
import sys

import torch

from ghgs_lit.config import build, compose, resolve
from ghgs_lit.diagnostics.benchmark.memory import PeakProbe
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.diagnostics.benchmark.stages import TOTAL
from ghgs_lit.diagnostics.benchmark.weights import random_model
from ghgs_lit.diagnostics.doctor.estimate import Scene, estimate
from ghgs_lit.model import GHGS

#: Blocks above this size go back to the system when they are freed.
_AT_ONCE = {"MALLOC_MMAP_THRESHOLD_": "65536", "MALLOC_TRIM_THRESHOLD_": "65536"}


def measured_prediction(config: dict, scene: Scene, device: torch.device) -> int:
    """Peak bytes of a second prediction in addition to the weights."""
    model = random_model(config).to(device)
    batch = dataclasses.replace(_batch(scene), targets=None).to(device)
    with torch.no_grad():
        model(batch)
        probe = PeakProbe(device)
        probe.begin(TOTAL)
        model(batch)
        probe.end(TOTAL)
    return probe.peaks[TOTAL]


def measured_training(config: dict, scene: Scene, device: torch.device) -> int:
    """Peak bytes of a second training step in addition to weights and moments."""
    model, renderer = GHGS.from_config(config).to(device), build(config["renderer"], "renderer")
    losses, optimizer = (
        build(config["loss"], "loss"),
        build(config["optimizer"], "optimizer").optimizer(model),
    )
    batch = _batch(scene)
    batch = dataclasses.replace(
        batch, depths=2.0 * batch.masks, body_vertices=[torch.rand(10475, 3) for _ in batch.images]
    ).to(device)
    for _ in range(2):
        optimizer.zero_grad()
        probe = PeakProbe(device)
        probe.begin(TOTAL)
        prediction = model(batch)
        total = losses(prediction, renderer(prediction.gaussians, batch.targets.cameras), batch)[0]
        del prediction
        total.backward()
        probe.end(TOTAL)
        optimizer.step()
        del total
    return probe.peaks[TOTAL]


def _batch(scene: Scene):
    return ellipsoid_batch(scene.share, scene.views, scene.size, scene.batch)


def compare(
    overrides: list[str], size: int, views: int, batch: int, device: torch.device, training: bool
) -> dict[str, int]:
    """Bytes by estimate and by measurement, weights and moments included."""
    config = resolve(compose("train", overrides))
    scene = Scene(0.15, views, (size, size), batch)
    needed = estimate(config, scene, device.type, "float32", training)
    measured = (measured_training if training else measured_prediction)(config, scene, device)
    return {"estimated": needed.bytes, "measured": needed.held + measured, "held": needed.held}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("overrides", nargs="*", help="of the configuration, such as encoder=vggt_small")
    parser.add_argument("--size", type=int, default=140)
    parser.add_argument("--views", type=int, default=4)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"))
    parser.add_argument("--json", action="store_true", help="one line for a program")
    options = parser.parse_args()
    if _AT_ONCE.items() - os.environ.items():
        sys.exit(subprocess.call([sys.executable, *sys.argv], env={**os.environ, **_AT_ONCE}))
    torch.set_num_threads(1)
    for what in ("prediction", "training"):
        scene = options.size, options.views, options.batch, options.device
        found = compare(options.overrides, *scene, what == "training")
        if options.json:
            print(json.dumps({"what": what, **found}))
            continue
        megabytes = ", ".join(f"{name} {value / 1e6:.1f} MB" for name, value in found.items())
        print(f"{what}: {megabytes}, ratio {found['estimated'] / found['measured']:.2f}", flush=True)


if __name__ == "__main__":
    main()
