"""Frames a second of a live view: ``python benchmarks/live.py [checkpoint=shipped] [presets=[exact,fast]]``.

From decoded photographs and masks in memory (uint8) to the finished picture (uint8) of another view, with
random weights where no checkpoint is named. The presets take turns, so that drift of the machine hits all
alike. Times are medians of ``--repeats`` frames.

Small frames hardly use a second core. ``--in-flight 2`` gives each of two processes one of two threads and
every other frame: more frames a second, each of which takes longer. Frames a second are then those whose
pictures have come back, in their order.
"""

import argparse
import dataclasses
import multiprocessing
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from statistics import median, quantiles

import numpy as np
import torch
from torch import Tensor

from ghgs_lit.cli.benchmark import check_options, configured_cases
from ghgs_lit.cli.inputs import pick_device
from ghgs_lit.config import run_of
from ghgs_lit.diagnostics.benchmark.measure import order
from ghgs_lit.diagnostics.benchmark.presets import Case
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.diagnostics.benchmark.stages import TOTAL, SecondsProbe, forward, top_level
from ghgs_lit.diagnostics.machine import in_words, machine_facts
from ghgs_lit.runtime.allocation import keep_freed_memory
from ghgs_lit.types import Batch
from ghgs_lit.visualization.pictures import to_uint8

#: Frames of each process that are drawn before it is another preset's turn.
_BLOCK = 5


def scene(share: float, views: int, size: int, target: int) -> tuple[Batch, Tensor]:
    """A scene with a target between the first two views; photographs [1, V, H, W, 3] uint8."""
    batch = ellipsoid_batch(share, views, size, 1)
    between = ellipsoid_batch(share, 2 * views, size, 1).cameras[:, 1:2].resized(target, target)
    batch = dataclasses.replace(batch, targets=dataclasses.replace(batch.targets, cameras=between))
    return batch, (batch.images.movedim(2, -1) * 255).byte()


@dataclasses.dataclass(frozen=True)
class Live:
    """What draws the frames: models, and the cameras and photographs of a scene."""

    cases: list[Case]
    batch: Batch
    photographs: Tensor
    device: torch.device

    @classmethod
    def of(cls, options: argparse.Namespace) -> "Live":
        torch.set_num_threads(max(1, options.threads // options.in_flight))
        keep_freed_memory()  # as the command line does
        run = run_of("benchmark", options.options)
        device = pick_device(run.device)
        check_options(run, options.options)
        cases = configured_cases(run, device)
        batch, photographs = scene(options.share, options.views, options.size, options.target)
        return cls(cases, batch.to(device), photographs, device)

    def frame(self, case: int, photographs: Tensor) -> tuple[dict[str, float], np.ndarray]:
        """Predict and draw one picture; the seconds of its stages, and the picture."""
        model, renderer = self.cases[case].model, self.cases[case].renderer
        probe, started = SecondsProbe(self.device), time.perf_counter()
        images = (photographs.to(self.device).float() / 255).movedim(-1, 2)
        _, rendering = forward(model, renderer, dataclasses.replace(self.batch, images=images), probe)
        picture = to_uint8(rendering.image[0, 0])
        return {**probe.seconds(), TOTAL: time.perf_counter() - started}, picture


#: Of a process that draws every other frame.
_own: Live


def _start(options: argparse.Namespace) -> None:
    global _own
    _own = Live.of(options)


def _drawn(case: int, photographs: np.ndarray) -> tuple[dict[str, float], np.ndarray]:
    return _own.frame(case, torch.from_numpy(photographs))


#: What the scene and the measurement here do not take from the configuration.
_FIXED = ("data", "views", "targets", "split", "subjects", "task", "threads", "timing")

#: Draws a number of frames of a case: the seconds of the stages of each.
Draw = Callable[[int, int], list[dict[str, float]]]


def one_by_one(live: Live, case: int, count: int) -> list[dict[str, float]]:
    return [live.frame(case, live.photographs)[0] for _ in range(count)]


def in_flight(pool: ProcessPoolExecutor, live: Live, case: int, count: int) -> list[dict[str, float]]:
    frames = [live.photographs.numpy()] * count
    return [seconds for seconds, _ in pool.map(partial(_drawn, case), frames)]


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
    parser.add_argument("--in-flight", type=int, default=1, help="frames at a time, each in a process")
    parser.add_argument("options", nargs="*", help="overrides of `ghgs benchmark`, such as device=cuda")
    options = parser.parse_intermixed_args()
    for option in options.options:
        if option.lstrip("+~").split("=")[0].split(".")[0] in _FIXED:
            parser.error(f"{option}: expected an option of the model; see --threads, --repeats and --views")
    if options.in_flight < 1:
        parser.error(f"--in-flight: expected 1 or more; found {options.in_flight}")
    live = Live.of(options)
    if options.in_flight == 1:
        measured(live, partial(one_by_one, live), options.repeats, 1)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.in_flight, context, _start, (options,)) as pool:
        measured(live, partial(in_flight, pool, live), options.repeats, _BLOCK * options.in_flight)


def measured(live: Live, draw: Draw, repeats: int, block: int) -> None:
    """Let the presets draw ``block`` frames in turn until each has ``repeats``, and report."""
    seconds: list[dict[str, list[float]]] = [defaultdict(list) for _ in live.cases]
    rates: list[list[float]] = [[] for _ in live.cases]
    for turn in range(-2, -(-repeats // block)):
        for number in order(turn, len(live.cases)):
            started = time.perf_counter()
            frames = draw(number, block)
            rate = block / (time.perf_counter() - started)
            if turn < 0:
                continue
            rates[number].append(rate)
            for stage, value in ((name, value) for found in frames for name, value in found.items()):
                seconds[number][stage].append(value)
    report(live, seconds, rates)


def report(live: Live, seconds: list[dict[str, list[float]]], rates: list[list[float]]) -> None:
    """Print milliseconds by stage and frames a second in Markdown."""
    names = [*top_level(seconds[0]), "other", TOTAL]
    print(in_words(machine_facts(live.device)))
    print("\n| ms | " + " | ".join([*names, "quartiles", "frames a second"]) + " |")
    print("|---" * (len(names) + 3) + "|")
    for case, found, rate in zip(live.cases, seconds, rates, strict=True):
        low, _, high = (1e3 * value for value in quantiles(found[TOTAL], n=4))
        cells = [f"{1e3 * median(found[name]):.1f}" for name in names]
        print(f"| {case.label} | " + " | ".join(cells) + f" | {low:.0f} to {high:.0f} | {median(rate):.1f} |")


if __name__ == "__main__":
    main()
