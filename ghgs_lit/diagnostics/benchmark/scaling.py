"""How cost grows: with the subject's share of the frame, views, image size, batch and threads."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from ghgs_lit.diagnostics.benchmark.measure import Job, Progress, Record, inspect, time_jobs
from ghgs_lit.diagnostics.benchmark.presets import Case
from ghgs_lit.diagnostics.benchmark.report import Table, stage_row
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.diagnostics.benchmark.stages import OTHER
from ghgs_lit.errors import require
from ghgs_lit.runs.results import Row

AXES = ("share", "views", "size", "batch", "threads")
#: The exponent of threads that share all work evenly; those of other axes are the FLOPs'.
_IDEAL_THREADS = -1.0


@dataclass(frozen=True)
class Axes:
    """Values along each axis; elsewhere everything is as in ``base``.

    Args:
        share: parts of the frame that the subject covers.
        views: numbers of input views.
        size: sides of the photographs in pixels.
        batch: numbers of elements.
        threads: of PyTorch.
        base: one value of each, but of the threads.
    """

    share: Sequence[float]
    views: Sequence[int]
    size: Sequence[int]
    batch: Sequence[int]
    threads: Sequence[int]
    base: Mapping[str, Any]

    def __post_init__(self) -> None:
        for name in AXES:
            values = getattr(self, name)
            is_list = isinstance(values, Sequence) and not isinstance(values, str)
            require(is_list and all(v > 0 for v in values), f"scaling.{name}", "a list above 0", values)
        require(set(self.base) == set(AXES[:-1]), "scaling.base", ", ".join(AXES[:-1]), sorted(self.base))
        require(any(getattr(self, name) for name in AXES), "scaling", "an axis with values", "none")


def exponent(values: Sequence[float], costs: Sequence[float | None]) -> float | None:
    """The exponent p of ``cost = c value^p``, by least squares of the logarithms.

    None where there are fewer than two values, or a cost that is not known or not above 0.
    """
    if len(set(values)) < 2 or any(cost is None or cost <= 0 for cost in costs):
        return None
    return float(np.polyfit(np.log(values), np.log(costs), 1)[0])


def study(
    cases: Sequence[Case],
    axes: Axes,
    device: torch.device,
    warmup: int,
    repeats: int,
    count_flops: bool,
    progress: Progress,
) -> tuple[list[Row], list[dict[str, Any]]]:
    """Measure cases along all axes.

    Args:
        cases: what is measured.
        axes: where.
        device: where the models are.
        warmup, repeats: rounds of each axis, in which all its values and cases are interleaved.
        count_flops: whether FLOPs are counted.
        progress: called after each forward pass but those for the FLOPs.

    Returns:
        Rows as of presets with ``axis`` and ``value``, and the exponents of :func:`fits_of`.
    """
    rows: list[Row] = []
    for axis in AXES:
        jobs, records, values = [], [], []
        for value in getattr(axes, axis):
            setting = {**axes.base, axis: value}
            count = setting.pop("threads", None)
            batch = ellipsoid_batch(**setting).to(device)
            for case in cases:
                work, *_ = inspect(case, batch, device, count_flops)
                jobs.append(Job(case, [batch], count))
                records.append(Record(case, {}, work))
                values.append(value)
                progress(f"{axis} {value}")
        timed = time_jobs(jobs, warmup, repeats, device, progress) if jobs else []
        for record, times, value in zip(records, timed, values, strict=True):
            record.times = times
            rows += [stage_row(record, stage, {"axis": axis, "value": value}) for stage in times]
    return rows, fits_of(rows)


def passes(cases: int, axes: Axes, rounds: int) -> int:
    """Number of times that :func:`study` calls ``progress``."""
    return cases * (1 + rounds) * sum(len(getattr(axes, axis)) for axis in AXES)


def fits_of(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The exponent of the seconds of each stage along each axis, and the expected one.

    Expected are the exponent of the FLOPs of the same runs and, of threads, -1; None where there are none.
    """
    groups: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        if row["stage"] != OTHER:
            groups.setdefault((row["axis"], row["preset"], row["stage"]), []).append(row)
    fits = []
    for (axis, preset, stage), own in groups.items():
        values = [row["value"] for row in own]
        found = exponent(values, [row["seconds"] for row in own])
        expected = _IDEAL_THREADS if axis == "threads" else exponent(values, [row["flops"] for row in own])
        about = {"axis": axis, "preset": preset, "stage": stage}
        fits.append({**about, "exponent": found, "expected": expected})
    return fits


def tables_of(rows: Sequence[Row], fits: Sequence[Mapping[str, Any]]) -> list[Table]:
    """Seconds of whole passes along each axis, then all exponents."""
    tables = []
    for axis in dict.fromkeys(row["axis"] for row in rows):
        own = [row for row in rows if row["axis"] == axis and row["stage"] == "total"]
        values = list(dict.fromkeys(row["value"] for row in own))
        seconds = {(row["preset"], row["value"]): f"{row['seconds']:.3f}" for row in own}
        presets = dict.fromkeys(row["preset"] for row in own)
        lines = tuple((preset, *(seconds[preset, value] for value in values)) for preset in presets)
        tables.append(Table(f"Seconds by {axis}", ("preset", *(f"{value:g}" for value in values)), lines))
    lines = tuple(
        (fit["axis"], fit["preset"], fit["stage"], _number(fit["exponent"]), _number(fit["expected"]))
        for fit in fits
    )
    return [*tables, Table("Exponents", ("axis", "preset", "stage", "fitted", "expected"), lines)]


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
