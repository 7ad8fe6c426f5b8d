"""Measurement of cases: work, differences from the yardstick, and seconds of each stage."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Bool, Int
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
from ghgs_lit.runs.progress import track
from ghgs_lit.runs.results import Row
from ghgs_lit.runtime.allocation import can_forget_peak, forget_peak, resident_bytes, return_free_memory
from ghgs_lit.runtime.watching import Stopwatch, Watcher, watch_block, watch_stages
from ghgs_lit.types import Batch, Gaussians, Prediction, Rendering

ROUNDS = "rounds"
RENDER = "render"
TOTAL = "total"
OTHER = "other"  #: Work outside of stages: checks, padding
#: Modules of parts of stages, by ``<stage>.<part>``.
PARTS = {"encoder.patch_tokens": "encoder.aggregator.patch_embed"}
#: All timed names in the order of the data flow; those without a dot add up to ``total``.
NAMES = (*STAGES[:1], *PARTS, *STAGES[1:], ROUNDS, RENDER, OTHER, TOTAL)


class SecondsProbe(Stopwatch):
    """Times of the stages and of the rest."""

    def seconds(self) -> dict[str, float]:
        """Seconds by name, in the order of :data:`NAMES`."""
        known = super().seconds()
        known[OTHER] = known[TOTAL] - sum(known[name] for name in top_level(known))
        return {name: known[name] for name in NAMES if name in known}


def top_level(names: Iterable[str]) -> list[str]:
    """Names of whole stages, without parts, ``other`` and ``total``."""
    return [name for name in names if "." not in name and name not in (OTHER, TOTAL)]


def watched(model: GHGS, probe: Watcher) -> AbstractContextManager[None]:
    """Context in which a probe watches the stages of a model and their parts.

    Args:
        model: has the stages.
        probe: is called when they begin and end.
    """
    names = [*STAGES, *([] if isinstance(model.rounds, NoRounds) else [ROUNDS])]
    return watch_stages(model, {name: name for name in names} | PARTS, probe)


@torch.inference_mode()
def forward(
    predictor: Predictor, renderer: Renderer, batch: Batch, probe: Watcher | None = None
) -> tuple[Prediction, Rendering]:
    """Predict the Gaussians of a batch and render its targets under a probe.

    Args:
        predictor: with a model in evaluation mode.
        renderer: draws the targets.
        batch: with targets, which the model does not see.
        probe: is called when stages, rendering and the whole begin and end; None: nothing is.
    """
    probe = probe or Watcher()
    with watched(predictor.model, probe), watch_block(TOTAL, probe):
        prediction = predictor(replace(batch, targets=None))
        with watch_block(RENDER, probe):
            rendering = renderer(prediction.gaussians, batch.targets.cameras)
    return prediction, rendering


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
    keys = [(g.image.cpu().long() << 40 | g.pixel.cpu()).numpy() for g in (found, expected)]
    _, *pairs = np.intersect1d(*keys, return_indices=True)
    return tuple(torch.from_numpy(index).to(found.means.device) for index in pairs)


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
        moved = forward(case.predictor, case.renderer, replace(batch, images=images))
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


@dataclass
class Record:
    """Measurements of a case.

    Attributes:
        case: what was measured.
        costs: of each batch, from :func:`inspect`.
        changes: differences from the yardstick for each batch.
        metrics: rows of errors against the truth.
        seconds: of each round that counts, by stage.
    """

    case: Case
    costs: list[dict[str, float]] = field(default_factory=list)
    changes: list[dict[str, float]] = field(default_factory=list)
    metrics: list[Row] = field(default_factory=list)
    seconds: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))


def flop_counter() -> FlopCounterMode:
    """Context that counts products, convolutions and attention; not element-wise operations and the
    rasterizer. PyTorch's counter lacks attention on a CPU."""

    def attention(q: tuple, k: tuple, v: tuple, *_: object, **__: object) -> int:
        return sdpa_flop_count(q, k, v)

    kernels = (attend.packet, torch.ops.aten._scaled_dot_product_flash_attention_for_cpu)
    return FlopCounterMode(display=False, custom_mapping=dict.fromkeys(kernels, attention))


def inspect(case: Case, batch: Batch, device: torch.device) -> tuple[dict[str, float], Result]:
    """Predict a batch once to count FLOPs and once to measure memory.

    Args:
        case: predicts.
        batch: with targets, which are rendered.
        device: where the model and the batch are.

    Returns:
        FLOPs, peak bytes beyond weights and photographs (NaN where the system has no counter), numbers
        of tokens, points and Gaussians and bytes of the PLY; the prediction and the render.
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
    """Measure seconds of each stage of each case, in interleaved rounds; each begins with another case, so
    that drift affects all alike.

    Args:
        records: of the cases, which get the seconds.
        batches: with targets; a round of a case takes the mean over them.
        warmup: rounds that do not count.
        repeats: rounds that count, at least 1.
        device: where models and batches are.
    """
    for turn in track(range(-warmup, repeats), "rounds"):
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
    records = [Record(case) for case in cases]
    for batch in track(batches, "errors"):
        for record in records:
            cost, result = inspect(record.case, batch, device)
            if record is records[0]:
                yardstick = result
                condition = amplification(record.case, batch, result)
            change = differences(result, yardstick, batch.masks)
            record.costs.append(cost)
            record.changes.append(change | {"rel_diff": conditioned(result, yardstick, batch, condition)})
            # The error against the truth, as `ghgs evaluate` measures it; its time does not count.
            prediction, rendering = result
            estimate = Estimate(rendering.image, prediction.depth, prediction.depth_valid)
            measured = measure(lambda _, known=estimate: known, record.case.label, [batch], metrics, device)
            record.metrics += [{k: v for k, v in row.items() if k != "seconds"} for row in measured]
    time_cases(records, batches, WARMUP, repeats, device)
    return records
