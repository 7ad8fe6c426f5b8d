"""Frames a second of a live view: ``python benchmarks/live.py [checkpoint=shipped] [presets=[exact,fast]]``.

From decoded photographs and masks in memory (uint8) to the finished picture (uint8) of another view, with
random weights where no checkpoint is named. The presets take turns, so that drift of the machine hits all
alike. Times are medians of ``--repeats`` frames.
"""

import argparse
import dataclasses
import time
from collections import defaultdict
from statistics import median, quantiles

import torch
from torch import Tensor

from ghgs_lit.benchmark.machine import in_words, machine_facts
from ghgs_lit.benchmark.measure import order
from ghgs_lit.benchmark.presets import Case, readers_of_skip
from ghgs_lit.benchmark.scene import ellipsoid_batch
from ghgs_lit.benchmark.stages import TOTAL, SecondsProbe, forward, top_level
from ghgs_lit.cli.benchmark import check_options, configured_cases
from ghgs_lit.cli.inputs import pick_device
from ghgs_lit.config import compose, resolve
from ghgs_lit.kernels.allocation import keep_freed_memory
from ghgs_lit.types import Batch
from ghgs_lit.visualization.pictures import to_uint8


def scene(share: float, views: int, size: int, target: int) -> tuple[Batch, Tensor]:
    """A scene with a target between the first two views; photographs [1, V, H, W, 3] uint8."""
    batch = ellipsoid_batch(share, views, size, 1)
    between = ellipsoid_batch(share, 2 * views, size, 1).cameras[:, 1:2].resized(target, target)
    batch = dataclasses.replace(batch, targets=dataclasses.replace(batch.targets, cameras=between))
    return batch, (batch.images.movedim(2, -1) * 255).byte()


def frame(case: Case, batch: Batch, photographs: Tensor, device: torch.device) -> dict[str, float]:
    """Predict and draw one picture; the seconds of its stages."""
    probe, started = SecondsProbe(device), time.perf_counter()
    images = (photographs.to(device).float() / 255).movedim(-1, 2)
    _, rendering = forward(case.model, case.renderer, dataclasses.replace(batch, images=images), probe)
    to_uint8(rendering.image[0, 0])
    return {**probe.seconds(), TOTAL: time.perf_counter() - started}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=50, help="frames of each preset")
    parser.add_argument(
        "--share", type=float, default=0.15, help="part of the photographs that the subject covers"
    )
    parser.add_argument("--views", type=int, default=4, help="photographs of a frame")
    parser.add_argument("--size", type=int, default=252, help="side of the photographs in pixels")
    parser.add_argument("--target", type=int, default=512, help="side of the picture in pixels")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("options", nargs="*", help="overrides of `ghgs benchmark`, such as device=cuda")
    options = parser.parse_intermixed_args()
    torch.set_num_threads(options.threads)
    keep_freed_memory()  # as the command line does
    cfg = compose("benchmark", options.options)
    config = resolve(cfg)
    device = pick_device(config["device"])
    check_options(config, options.options)
    cases = configured_cases(config, readers_of_skip(cfg), device)
    batch, photographs = scene(options.share, options.views, options.size, options.target)
    batch = batch.to(device)
    seconds: list[dict[str, list[float]]] = [defaultdict(list) for _ in cases]
    for turn in range(-2, options.repeats):
        for number in order(turn, len(cases)):
            for stage, value in frame(cases[number], batch, photographs, device).items():
                if turn >= 0:
                    seconds[number][stage].append(value)
    report(cases, seconds, device)


def report(cases: list[Case], seconds: list[dict[str, list[float]]], device: torch.device) -> None:
    """Print milliseconds by stage and frames a second in Markdown."""
    names = [*top_level(seconds[0]), "other", TOTAL]
    print(in_words(machine_facts(device)))
    print("\n| ms | " + " | ".join([*names, "quartiles", "frames a second"]) + " |")
    print("|---" * (len(names) + 3) + "|")
    for case, found in zip(cases, seconds, strict=True):
        low, middle, high = (1e3 * value for value in quantiles(found[TOTAL], n=4))
        cells = [f"{1e3 * median(found[name]):.1f}" for name in names]
        print(f"| {case.label} | " + " | ".join(cells) + f" | {low:.0f} to {high:.0f} | {1e3 / middle:.1f} |")


if __name__ == "__main__":
    main()
