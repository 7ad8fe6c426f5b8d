"""Measurement of cases: cost, differences from the reference, and seconds of each stage."""

import math
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int
from rich.progress import track
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from ghgs_lit.diagnostics.benchmark.cases import Case
from ghgs_lit.evaluation.measure import Estimate, Renderer, measure
from ghgs_lit.execution import Predictor
from ghgs_lit.method.model import GHGS, STAGES
from ghgs_lit.method.rounds import NoRounds
from ghgs_lit.metrics import ImageMetrics
from ghgs_lit.metrics.functional import decibels, squared_error
from ghgs_lit.ops.attention import attend
from ghgs_lit.ply import ply_bytes
from ghgs_lit.runs.results import Row
from ghgs_lit.runtime.allocation import can_forget_peak, forget_peak, resident_bytes, return_free_memory
from ghgs_lit.runtime.watching import Watcher, watch_block, watch_stages
from ghgs_lit.types import Batch, Gaussians, Prediction, Rendering

#: Point in time: seconds on the CPU, an event on CUDA.
Mark = float | torch.cuda.Event
ROUNDS = "rounds"
RENDER = "render"
TOTAL = "total"
OTHER = "other"  #: Work outside of stages: checks, padding
#: Modules that are parts of stages, by ``<stage>.<part>``.
PARTS = {"encoder.patch_tokens": "encoder.aggregator.patch_embed"}
#: All timed names in the order of the data flow; those without a dot add up to ``total``.
NAMES = (*STAGES[:1], *PARTS, *STAGES[1:], ROUNDS, RENDER, OTHER, TOTAL)


class SecondsProbe(Watcher):
    """Total times of the stages on ``device``, with events on CUDA, and of all work outside of them."""

    def __init__(self, device: torch.device):
        self.device = device
        self._open: list[Mark] = []
        self._spans: list[tuple[str, Mark, Mark]] = []

    def begin(self, stage: str) -> None:
        self._open.append(self._now())

    def end(self, stage: str, result: Any = None) -> None:
        self._spans.append((stage, self._open.pop(), self._now()))

    def _now(self) -> Mark:
        """Current time; on CUDA the time when all work submitted so far has finished."""
        if self.device.type != "cuda":
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self.device))
        return event

    def seconds(self) -> dict[str, float]:
        """Seconds by name, in the order of :data:`NAMES`; synchronizes with the device."""
        is_cuda = self.device.type == "cuda"
        if is_cuda:
            torch.cuda.synchronize(self.device)
        known: dict[str, float] = defaultdict(float)
        for stage, begin, end in self._spans:
            known[stage] += begin.elapsed_time(end) / 1e3 if is_cuda else end - begin
        known[OTHER] = known[TOTAL] - sum(known[name] for name in top_level(known))
        return {name: known[name] for name in NAMES if name in known}


def top_level(names: Iterable[str]) -> list[str]:
    """Names of whole stages, without parts, ``other`` and ``total``."""
    return [name for name in names if "." not in name and name not in (OTHER, TOTAL)]


def watch_model(model: GHGS, probe: Watcher) -> AbstractContextManager[None]:
    """Context in which a probe is called when a stage of a model, or a part of one, begins and ends."""
    names = [*STAGES, *([] if isinstance(model.rounds, NoRounds) else [ROUNDS])]
    return watch_stages(model, {name: name for name in names} | PARTS, probe)


@torch.inference_mode()
def forward(
    predictor: Predictor, renderer: Renderer, batch: Batch, probe: Watcher | None = None
) -> tuple[Prediction, Rendering]:
    """Predict the Gaussians of a batch and render its targets.

    Args:
        predictor: its model is in evaluation mode.
        renderer: renders from the target cameras.
        batch: with targets, which are removed before the prediction.
        probe: is called when stages, the rendering and the whole begin and end.
    """
    probe = probe or Watcher()
    with watch_model(predictor.model, probe), watch_block(TOTAL, probe):
        prediction = predictor(replace(batch, targets=None))
        with watch_block(RENDER, probe):
            rendering = renderer(prediction.gaussians, batch.targets.cameras)
    return prediction, rendering


ATTRIBUTES = ("means", "quaternions", "scales", "opacities", "colors")
#: Share of the values that a budget is compared with: where a decision lies within rounding (which of two
#: points is nearer, whether a splat is rendered at all), single values change by any amount.
MOST = 0.99
#: Number of random roundings of the images in :func:`amplification`
_ROUNDINGS = 2


def relative_difference(found: Tensor, expected: Tensor, share: float = 1.0) -> float:
    """``|found - expected| / max|expected|`` that a share of the values does not exceed.

    Args:
        found: of any shape.
        expected: of the same shape.
        share: of the values, in (0, 1]; 1: the largest difference.

    Returns:
        The difference; infinite if a difference is not finite, or if only ``expected`` is 0 everywhere; 0
        for empty tensors.
    """
    if found.numel() == 0:
        return 0.0
    difference = (found - expected).double().abs().flatten()
    if not difference.isfinite().all():
        return math.inf
    difference = difference.kthvalue(max(1, math.floor(share * len(difference)))).values.item()
    largest = expected.abs().max().item()
    return difference / largest if largest > 0 else (0.0 if difference == 0 else math.inf)


def match_gaussians(found: Gaussians, expected: Gaussians) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Match the Gaussians of two predictions for a batch that belong to the same input pixel.

    Returns:
        Indices [n] into ``found`` and ``expected``. If either has no input pixels, Gaussians are matched in
        their order.
    """
    if found.image is None or expected.image is None:
        n = min(len(found), len(expected))
        return torch.arange(n), torch.arange(n)
    keys = [(g.image.cpu().long() << 40 | g.pixel.cpu()).numpy() for g in (found, expected)]
    _, *pairs = np.intersect1d(*keys, return_indices=True)
    return tuple(torch.from_numpy(index).to(found.means.device) for index in pairs)


Result = tuple[Prediction, Rendering]


def differences(
    found: Result, expected: Result, masks: Bool[Tensor, "..."], share: float = 1.0
) -> dict[str, float]:
    """Differences of a prediction from a reference.

    Args:
        found: prediction for a batch, and its render.
        expected: those of the reference, for the same batch.
        masks: of the inputs [B, V, H, W].
        share: as for :func:`relative_difference`; at most :data:`MOST` for renders.

    Returns:
        By name: :func:`relative_difference` of each of :data:`ATTRIBUTES`, of the subject's
        ``depth`` and of the ``render``; the largest of these, ``max_rel_diff``; mean squared error
        ``mse_to_none`` and ``psnr_to_none`` (dB) of the renders; and ``unmatched``, the number of
        Gaussians that are in one prediction only, over that of the reference.
    """
    (prediction, rendering), (reference, target) = found, expected
    ours = prediction.gaussians
    theirs = reference.gaussians
    a, b = match_gaussians(ours, theirs)
    result = {n: relative_difference(getattr(ours, n)[a], getattr(theirs, n)[b], share) for n in ATTRIBUTES}
    result["render"] = relative_difference(rendering.image, target.image, min(share, MOST))
    valid = prediction.depth_valid & reference.depth_valid & masks
    result["depth"] = relative_difference(prediction.depth[valid], reference.depth[valid], share)
    error = squared_error(rendering.image.flatten(0, 1), target.image.flatten(0, 1)).mean()
    missing = max(len(theirs), len(ours)) - len(a)
    return {
        **result,
        "max_rel_diff": max(result.values()),
        "mse_to_none": error.item(),
        "psnr_to_none": decibels(error[None]).item(),
        "unmatched": missing / max(len(theirs), 1),
    }


def amplification(case: Case, batch: Batch, result: Result) -> dict[str, float]:
    """Condition number of a result: how far :data:`MOST` values change where the input images are rounded at
    random. Another order of summation causes as large a rounding in every layer.

    Args:
        case: that gave the result.
        batch: with targets.
        result: of the case for the batch.

    Returns:
        Changes by the names of :func:`differences`, in units of the rounding; the larger of two
        roundings, at least 1.
    """
    eps = torch.finfo(batch.images.dtype).eps
    largest: dict[str, float] = {}
    for seed in range(_ROUNDINGS):
        signs = 1 - 2 * torch.randint(2, batch.images.shape, generator=torch.Generator().manual_seed(seed))
        images = (batch.images * (1 + eps * signs.to(batch.images))).clamp(0, 1)
        moved = forward(case.predictor, case.renderer, replace(batch, images=images))
        for name, value in differences(moved, result, batch.masks, MOST).items():
            largest[name] = max(largest.get(name, 1.0), value / eps)
    return largest


def conditioned_difference(
    found: Result, expected: Result, batch: Batch, condition: Mapping[str, float]
) -> float:
    """Largest of the differences of attributes, depth and render of :data:`MOST` values, each divided by its
    condition number.

    Args:
        found: prediction for a batch, and its render.
        expected: those of the reference.
        batch: the inputs.
        condition: of the reference, from :func:`amplification`.
    """
    most = differences(found, expected, batch.masks, MOST)
    return max(most[name] / condition[name] for name in (*ATTRIBUTES, "render", "depth"))


WARMUP = 1  #: Rounds whose times do not count: the first compiles kernels and fills caches


@dataclass
class Record:
    """Measurements of a case.

    Attributes:
        case: that was measured.
        costs: of each batch, from :func:`inspect`.
        changes: :func:`differences` of each batch from the reference, and ``rel_diff``.
        metrics: rows of errors against the target images.
        seconds: of each round after the warm-up, by stage.
    """

    case: Case
    costs: list[dict[str, float]] = field(default_factory=list)
    changes: list[dict[str, float]] = field(default_factory=list)
    metrics: list[Row] = field(default_factory=list)
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


def flop_counter() -> FlopCounterMode:
    """Context that counts products, convolutions and attention; neither element-wise operations nor the
    rasterizer. PyTorch's counter lacks attention on a CPU."""

    def count_attention(q: tuple, k: tuple, v: tuple, *_: object, **__: object) -> int:
        return sdpa_flop_count(q, k, v)

    kernels = (attend.packet, torch.ops.aten._scaled_dot_product_flash_attention_for_cpu)
    return FlopCounterMode(display=False, custom_mapping=dict.fromkeys(kernels, count_attention))


def inspect(case: Case, batch: Batch, device: torch.device) -> tuple[dict[str, float], Result]:
    """Predict and render a batch twice: to count FLOPs, and to measure memory.

    Args:
        case: to run.
        batch: with targets.
        device: of the model and the batch.

    Returns:
        Cost by name: FLOPs, peak bytes beyond weights and inputs (NaN where the system has no counter),
        numbers of tokens, points and Gaussians, bytes of the PLY; and the prediction with its render.
    """
    with flop_counter() as counter:
        forward(case.predictor, case.renderer, batch)
    is_cuda = device.type == "cuda"
    return_free_memory()
    forget_peak()
    if is_cuda:
        torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device) if is_cuda else resident_bytes()
    prediction, rendering = forward(case.predictor, case.renderer, batch)
    peak = torch.cuda.max_memory_allocated(device) if is_cuda else resident_bytes("VmHWM")
    gaussians = prediction.gaussians
    work = {
        "flops": counter.get_total_flops(),
        "peak_bytes": peak - before if is_cuda or can_forget_peak() else math.nan,
        "tokens": prediction.points.tokens.shape[0],
        "points": int(prediction.points.valid.sum()),
        "gaussians": len(gaussians),
        "ply_bytes": sum(len(ply_bytes(gaussians[element])) for element in range(len(gaussians.splits))),
    }
    return work, (prediction, rendering)


def time_cases(
    records: Sequence[Record], batches: Sequence[Batch], warmup: int, repeats: int, device: torch.device
) -> None:
    """Measure the seconds of each stage of each case, in rounds of all cases. Each round begins with another
    case, so that drift affects all alike.

    Args:
        records: of the cases; the seconds are appended.
        batches: with targets; the seconds of a round are the mean over them.
        warmup: number of rounds whose times are dropped.
        repeats: number of further rounds, at least 1.
        device: of models and batches.
    """
    for turn in track(range(-warmup, repeats), "rounds", transient=True):
        for number in np.roll(np.arange(len(records)), -turn):
            record = records[number]
            probe = SecondsProbe(device)
            for batch in batches:
                forward(record.case.predictor, record.case.renderer, batch, probe)
            for stage, value in probe.seconds().items() if turn >= 0 else ():
                record.seconds[stage].append(value / len(batches))


def record_cases(
    cases: Sequence[Case], batches: Sequence[Batch], metrics: ImageMetrics, device: torch.device, repeats: int
) -> list[Record]:
    """Measure cost and error of cases, then their times.

    Args:
        cases: the reference first.
        batches: with targets.
        metrics: of renders against the targets.
        device: of models and batches.
        repeats: number of rounds for the times, at least 1.

    Returns:
        Measurements in the order of the cases.
    """
    records = [Record(case) for case in cases]
    for batch in track(batches, "errors", transient=True):
        for record in records:
            cost, result = inspect(record.case, batch, device)
            if record is records[0]:
                reference = result
                condition = amplification(record.case, batch, result)
            change = differences(result, reference, batch.masks)
            record.costs.append(cost)
            record.changes.append(
                change | {"rel_diff": conditioned_difference(result, reference, batch, condition)}
            )
            # Errors against the target images, as `ghgs evaluate` measures them; their time does not count.
            prediction, rendering = result
            estimate = Estimate(rendering.image, prediction.depth, prediction.depth_valid)
            measured = measure(lambda _, known=estimate: known, record.case.label, [batch], metrics, device)
            record.metrics += [{k: v for k, v in row.items() if k != "seconds"} for row in measured]
    time_cases(records, batches, WARMUP, repeats, device)
    return records
