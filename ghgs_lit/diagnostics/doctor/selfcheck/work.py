"""Times and memory of a prediction by stage, at the size and the number of views of the configuration."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from rich.filesize import decimal

from ghgs_lit.config.settings import image_size
from ghgs_lit.diagnostics.benchmark.memory import PeakProbe
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.diagnostics.benchmark.stages import TOTAL, SecondsProbe, watched
from ghgs_lit.diagnostics.benchmark.weights import random_model
from ghgs_lit.diagnostics.doctor.estimate import Scene, estimate
from ghgs_lit.diagnostics.doctor.selfcheck.outcome import FAILED, PASSED, SKIPPED, Outcome
from ghgs_lit.kernels.watching import Watcher, inside
from ghgs_lit.model import GHGS
from ghgs_lit.types import Batch

#: Passes before the one that is timed: libraries choose their algorithms in the first.
_WARMUP = 2
#: How far the estimate of memory may be off; the workspaces of cuDNN are not in it.
_LIMIT = 0.5


def work(config: Mapping[str, Any], device: torch.device) -> Iterator[Outcome]:
    """A prediction in float32 is timed; its memory is compared with the estimate of ``task=machine``."""
    size = image_size("data.size", config["data"]["size"])
    scene = Scene(config["share"], config["views"]["evaluation_count"], size)
    model = random_model(config).to(device)
    batch = ellipsoid_batch(scene.share, scene.views, scene.size, 1).to(device)
    for _ in range(_WARMUP):
        _predict(model, batch, PeakProbe(device))
    seconds, peaks = SecondsProbe(device), PeakProbe(device)
    _predict(model, batch, seconds)
    what = f"{scene.views} views of {size[0]} x {size[1]}"
    times = ", ".join(f"{name} {1e3 * value:.1f}" for name, value in seconds.seconds().items())
    yield Outcome(f"milliseconds, {what}", PASSED, times)
    check = f"memory, {what}"
    if device.type != "cuda":
        yield Outcome(check, SKIPPED, "only CUDA knows the memory of tensors; see ghgs doctor task=machine")
        return
    _predict(model, batch, peaks)
    expected = estimate(config, scene, "cuda", "float32")
    measured = expected.held + peaks.peaks[TOTAL]
    is_near = abs(expected.bytes / measured - 1) <= _LIMIT
    found = f"peak {decimal(measured)}, estimated {decimal(expected.bytes)}, limit {_LIMIT:.0%}"
    yield Outcome(check, PASSED if is_near else FAILED, found)


@torch.no_grad()
def _predict(model: GHGS, batch: Batch, probe: Watcher) -> None:
    with watched(model, probe), inside(TOTAL, probe):
        model(batch)
