"""How cost grows: with the subject's share of the frame, views, image size, batch and threads."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import torch

from ghgs_lit.diagnostics.benchmark.measure import Job, Record, inspect, time_jobs
from ghgs_lit.diagnostics.benchmark.presets import Case
from ghgs_lit.diagnostics.benchmark.report import stage_row, totals
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.diagnostics.benchmark.stages import OTHER
from ghgs_lit.diagnostics.output import Tables, pivoted, texts
from ghgs_lit.errors import require
from ghgs_lit.runs.results import Row

AXES = ("share", "views", "size", "batch", "threads")
#: Where the other axes stay beside the first size: a subject of a sixth of the frame, the usual four views.
BASE = {"share": 0.15, "views": 4, "batch": 1}
#: The exponent of threads that share all work evenly; those of other axes are the FLOPs'.
_IDEAL_THREADS = -1.0


def exponent(values: Sequence[float], costs: Sequence[float | None]) -> float | None:
    """The exponent p of ``cost = c value^p``, by least squares of the logarithms.

    None where there are fewer than two values, or a cost that is not known or not above 0.
    """
    if len(set(values)) < 2 or any(cost is None or cost <= 0 for cost in costs):
        return None
    return float(np.polyfit(np.log(values), np.log(costs), 1)[0])


def base_of(axes: Mapping[str, Any]) -> dict[str, Any]:
    """Where the other axes stay."""
    return {**BASE, "size": (*axes["size"], 140)[0]}


def study(
    cases: Sequence[Case],
    axes: Mapping[str, Any],
    device: torch.device,
    warmup: int,
    repeats: int,
) -> tuple[list[Row], list[dict[str, Any]]]:
    """Measure cases along all axes.

    Args:
        cases: what is measured.
        axes: by the names of :data:`AXES` the values along each.
        device: where the models are.
        warmup, repeats: rounds of each axis, in which all its values and cases are interleaved.

    Returns:
        Rows as of presets with ``axis`` and ``value``, and the exponents of :func:`fits_of`.
    """
    require(any(axes[axis] for axis in AXES), "scaling", "an axis with values", "none")
    rows: list[Row] = []
    for axis in AXES:
        jobs, records, values = [], [], []
        for value in axes[axis]:
            setting = {**base_of(axes), axis: value}
            count = setting.pop("threads", None)
            batch = ellipsoid_batch(**setting).to(device)
            for case in cases:
                work, *_ = inspect(case, batch, device)
                jobs.append(Job(case, [batch], count))
                records.append(Record(case, work))
                values.append(value)
        timed = time_jobs(jobs, warmup, repeats, device) if jobs else []
        for record, times, value in zip(records, timed, values, strict=True):
            record.times = times
            rows += [stage_row(record, stage, {"axis": axis, "value": value}) for stage in times]
    return rows, fits_of(rows)


def fits_of(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """The exponent of the seconds of each stage along each axis, and the expected one.

    Expected are the exponent of the FLOPs of the same runs and, of threads, -1; None where there are none.
    """
    frame = pd.DataFrame([row for row in rows if row["stage"] != OTHER])
    fits = []
    for (axis, preset, stage), group in frame.groupby(["axis", "preset", "stage"], sort=False):
        values, flops = list(group.value), [None if pd.isna(n) else n for n in group.flops]
        expected = _IDEAL_THREADS if axis == "threads" else exponent(values, flops)
        about = {"axis": axis, "preset": preset, "stage": stage}
        fits.append({**about, "exponent": exponent(values, list(group.seconds)), "expected": expected})
    return fits


def tables_of(rows: Sequence[Row], fits: Sequence[Mapping[str, Any]]) -> Tables:
    """Seconds of whole passes along each axis, then all exponents."""
    frame = pd.DataFrame(totals(rows))
    frame = frame.assign(value=frame.value.map("{:g}".format))
    tables = {
        f"Seconds by {axis}": pivoted(group, "preset", "value", "seconds", "{:.3f}")
        for axis, group in frame.groupby("axis", sort=False)
    }
    columns = {name: (name, "{}") for name in ("axis", "preset", "stage")}
    columns |= {"fitted": ("exponent", "{:.2f}"), "expected": ("expected", "{:.2f}")}
    return {**tables, "Exponents": texts(pd.DataFrame(fits), columns)}
