"""Measurement of cases: work, differences from the yardstick, and seconds of each stage."""

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ghgs_lit.diagnostics.benchmark.presets import Case
from ghgs_lit.diagnostics.benchmark.stages import FlopsProbe, PeakProbe, SecondsProbe, forward
from ghgs_lit.evaluation.measure import Estimate, measure
from ghgs_lit.metrics import ImageMetrics
from ghgs_lit.metrics.functional import decibels, squared_error
from ghgs_lit.ply import ply_bytes
from ghgs_lit.runs.progress import track
from ghgs_lit.runs.results import Row
from ghgs_lit.types import Batch, Gaussians, Prediction, Rendering

ATTRIBUTES = ("means", "quaternions", "scales", "opacities", "colors")
#: Share of the values that budgets judge differences by: where a decision lies within rounding
#: (which of two points is nearer, whether a splat is drawn at all), single values change as
#: far as they may.
MOST = 0.99
#: Random roundings of photographs that :func:`amplification` takes the larger effect of
_ROUNDINGS = 2


def relative_difference(found: Tensor, expected: Tensor, share: float = 1.0) -> float:
    """``|found - expected| / max|expected|``, which a ``share`` of the values does not exceed.

    Args:
        found: any shape.
        expected: of the same shape.
        share: of the values, above 0, at most 1; 1: the largest difference.

    Returns:
        The difference; infinite if a value of the difference is not finite, or only ``expected`` is
        0 everywhere; 0 without values.
    """
    if found.numel() == 0:
        return 0.0
    difference = (found - expected).double().abs().flatten()
    if not difference.isfinite().all():
        return math.inf
    difference = difference.kthvalue(max(1, math.floor(share * len(difference)))).values.item()
    largest = expected.abs().max().item()
    return difference / largest if largest > 0 else (0.0 if difference == 0 else math.inf)


def partners(found: Gaussians, expected: Gaussians) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Pair the Gaussians of the same input pixel.

    Args:
        found: Gaussians of a batch.
        expected: others of the same batch.

    Returns:
        Indices of the pairs [n] into both; those without a partner are left out. Without input
        pixels the first ones of both are pairs.
    """
    if found.image is None or expected.image is None:
        n = min(len(found), len(expected))
        return torch.arange(n), torch.arange(n)
    frames = [pd.DataFrame({"image": g.image.cpu(), "pixel": g.pixel.cpu()}) for g in (found, expected)]
    frames = [frame.rename_axis(name).reset_index() for frame, name in zip(frames, ("a", "b"), strict=True)]
    both = frames[0].merge(frames[1], on=["image", "pixel"])
    device = found.means.device
    return tuple(torch.tensor(both[name].to_numpy().copy(), device=device) for name in ("a", "b"))


Result = tuple[Prediction, Rendering]


def differences(
    found: Result, expected: Result, masks: Bool[Tensor, "..."], share: float = 1.0
) -> dict[str, float]:
    """Differences of a preset from the yardstick.

    Args:
        found: prediction of the preset and its render.
        expected: those of the yardstick, for the same batch.
        masks: of the inputs, shape [B, V, H, W].
        share: as for :func:`relative_difference`; of renders at most :data:`MOST`.

    Returns:
        By name. :func:`relative_difference` of each of :data:`ATTRIBUTES`, of the subject's
        ``depth`` and of the ``render``; their largest, ``max_rel_diff``; ``mse_to_none`` and
        ``psnr_to_none`` of the renders, the latter in dB; and ``unmatched``, the Gaussians
        without a partner (of the preset or the yardstick, whichever has more) over the number of
        the yardstick's.
    """
    (prediction, rendering), (yardstick, reference) = found, expected
    ours = prediction.gaussians
    theirs = yardstick.gaussians
    a, b = partners(ours, theirs)
    result = {n: relative_difference(getattr(ours, n)[a], getattr(theirs, n)[b], share) for n in ATTRIBUTES}
    result["render"] = relative_difference(rendering.image, reference.image, min(share, MOST))
    valid = prediction.depth_valid & yardstick.depth_valid & masks
    result["depth"] = relative_difference(prediction.depth[valid], yardstick.depth[valid], share)
    error = squared_error(rendering.image.flatten(0, 1), reference.image.flatten(0, 1)).mean()
    missing = max(len(theirs), len(ours)) - len(a)
    return {
        **result,
        "max_rel_diff": max(result.values()),
        "mse_to_none": error.item(),
        "psnr_to_none": decibels(error[None]).item(),
        "unmatched": missing / max(len(theirs), 1),
    }


def amplification(case: Case, batch: Batch, result: Result) -> dict[str, float]:
    """Condition of a result: how far most values move where all photographs are rounded
    once at random.

    Another order of summation rounds as much in every layer.

    Args:
        case: gives the result.
        batch: with targets.
        result: what the case gives for the batch.

    Returns:
        The movements by the names of :func:`differences`, in units of that rounding, the larger of
        two roundings; at least 1.
    """
    eps = torch.finfo(batch.images.dtype).eps
    largest: dict[str, float] = {}
    for seed in range(_ROUNDINGS):
        signs = 1 - 2 * torch.randint(2, batch.images.shape, generator=torch.Generator().manual_seed(seed))
        images = (batch.images * (1 + eps * signs.to(batch.images))).clamp(0, 1)
        moved = forward(
            case.predictor, case.renderer, replace(batch, images=images), SecondsProbe(images.device)
        )
        for name, value in differences(moved, result, batch.masks, MOST).items():
            largest[name] = max(largest.get(name, 1.0), value / eps)
    return largest


def conditioned(found: Result, expected: Result, batch: Batch, condition: Mapping[str, float]) -> float:
    """Largest difference of attributes, depth and render of :data:`MOST` values over
    their condition.

    Args:
        found: prediction of the preset and its render.
        expected: those of the yardstick.
        batch: what both are for.
        condition: from :func:`amplification`.
    """
    most = differences(found, expected, batch.masks, MOST)
    return max(most[name] / condition[name] for name in (*ATTRIBUTES, "render", "depth"))


WARMUP = 1  #: Rounds that do not count; the first compiles and fills caches


@dataclass(frozen=True)
class Times:
    """Seconds of a stage: median and quartiles of the rounds."""

    median: float
    low: float
    high: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> "Times":
        """Quartiles of the seconds of rounds, at least one."""
        low, median, high = np.quantile(seconds, (0.25, 0.5, 0.75)).tolist()
        return cls(median, low, high)


@dataclass
class Work:
    """Cost of a forward pass: FLOPs and peak bytes by stage;
    tokens, points, Gaussians and PLY bytes."""

    flops: dict[str, float]
    peaks: dict[str, int]
    counts: dict[str, float]

    @classmethod
    def of(cls, works: Sequence["Work"]) -> "Work":
        """Mean over batches, with the largest peaks."""
        flops = pd.DataFrame([work.flops for work in works])
        peaks = pd.DataFrame([work.peaks for work in works])
        counts = pd.DataFrame([work.counts for work in works])
        return cls(flops.mean().to_dict(), peaks.max().to_dict(), counts.mean().to_dict())


@dataclass
class Record:
    """Measurements of a case; ``differences`` are the worst over batches."""

    case: Case
    work: Work
    times: dict[str, Times] = field(default_factory=dict)
    differences: dict[str, float] = field(default_factory=dict)
    metrics: list[Row] = field(default_factory=list)


def order(turn: int, count: int) -> list[int]:
    """Order of the cases in a round; each begins one case later,
    so that drift affects all cases alike.

    Args:
        turn: number of the round; negative ones do not count.
        count: number of cases.
    """
    return [(turn + number) % count for number in range(count)]


def time_cases(
    cases: Sequence[Case], batches: Sequence[Batch], warmup: int, repeats: int, device: torch.device
) -> list[dict[str, Times]]:
    """Seconds of each stage of each case, in interleaved rounds.

    Args:
        cases: what is timed.
        batches: with targets; a round of a case takes the mean over them.
        warmup: rounds that do not count.
        repeats: rounds that count, at least 1.
        device: where models and batches are.

    Returns:
        For each case its times by stage.
    """
    seconds: list[dict[str, list[float]]] = [{} for _ in cases]
    for turn in track(range(-warmup, repeats), "rounds"):
        for number in order(turn, len(cases)):
            case = cases[number]
            probe = SecondsProbe(device)
            for batch in batches:
                forward(case.predictor, case.renderer, batch, probe)
            for stage, value in probe.seconds().items() if turn >= 0 else ():
                seconds[number].setdefault(stage, []).append(value / len(batches))
    times = []
    for stages in seconds:
        times.append({stage: Times.of(values) for stage, values in stages.items()})
    return times


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Run PyTorch with another number of threads while the context lasts.

    Args:
        count: at least 1; None: as many as now.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(count or before)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def inspect(case: Case, batch: Batch, device: torch.device) -> tuple[Work, Prediction, Rendering]:
    """Predict a batch once to count FLOPs and once to measure memory.

    Args:
        case: predicts.
        batch: with targets, which are rendered.
        device: where the model and the batch are.

    Returns:
        The cost, the prediction and the render.
    """
    with FlopsProbe() as counted:
        forward(case.predictor, case.renderer, batch, counted)
    memory = PeakProbe(device)
    prediction, rendering = forward(case.predictor, case.renderer, batch, memory)
    return Work(counted.flops, memory.peaks, _counts(prediction)), prediction, rendering


def _counts(prediction: Prediction) -> dict[str, float]:
    gaussians = prediction.gaussians
    return {
        "tokens": prediction.points.tokens.shape[0],
        "points": int(prediction.points.valid.sum()),
        "gaussians": len(gaussians),
        "ply_bytes": sum(len(ply_bytes(gaussians[element])) for element in range(len(gaussians.splits))),
    }


def record_cases(
    cases: Sequence[Case], batches: Sequence[Batch], metrics: ImageMetrics, device: torch.device, repeats: int
) -> list[Record]:
    """Measure work and error of cases, then their times.

    Args:
        cases: the yardstick first.
        batches: with targets.
        metrics: what is measured against the targets.
        device: where models and batches are.
        repeats: rounds of the times that count, at least 1.

    Returns:
        The measurements in the order of the cases.
    """
    works: list[list[Work]] = [[] for _ in cases]
    records = [Record(case, Work({}, {}, {})) for case in cases]
    for batch in track(batches, "errors"):
        for record, case_works in zip(records, works, strict=True):
            work, *result = inspect(record.case, batch, device)
            if record.case.is_yardstick:
                yardstick = result
                condition = amplification(record.case, batch, result)
            case_works.append(work)
            change = differences(result, yardstick, batch.masks)
            change["rel_diff"] = conditioned(result, yardstick, batch, condition)
            for name, value in change.items():
                worst = min if name == "psnr_to_none" else max
                record.differences[name] = worst(record.differences.get(name, value), value)
            # The error against the truth, as `ghgs evaluate` measures it; its time does not count.
            prediction, rendering = result
            depth = (prediction.depth, prediction.depth_valid)
            estimate = Estimate(rendering.image, *depth)
            measured = measure(lambda _, known=estimate: known, record.case.label, [batch], metrics, device)
            for row in measured:
                record.metrics.append({name: value for name, value in row.items() if name != "seconds"})
    times = time_cases(cases, batches, WARMUP, repeats, device)
    for record, case_works, seconds in zip(records, works, times, strict=True):
        record.work = Work.of(case_works)
        record.times = seconds
    return records
