"""A model beside what a user would pick instead: the same people and targets, error and seconds a subject."""

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from rich.progress import Progress

from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.diagnostics.benchmark.report import Table
from ghgs_lit.evaluation.measure import Method, measure
from ghgs_lit.metrics import ImageMetrics
from ghgs_lit.runs.journal import Journal
from ghgs_lit.runs.results import Row, by_protocol, summarize

#: Errors of the table, with their decimals.
SHOWN = {"psnr": 2, "psnr_box": 2, "ssim": 4, "flip": 4, "depth_error_mm": 1}


def measure_peers(
    methods: Mapping[str, Method],
    data: PhotographsDataModule,
    views: Sequence[int],
    targets: Mapping[str, Mapping[str, Any]],
    split: str,
    subjects: int | None,
    metrics: ImageMetrics,
    device: torch.device,
    journal: Journal,
    identity: str,
) -> list[Row]:
    """Measure every method on each subject alone.

    Args:
        methods: what is measured, by name.
        data: gives the photographs.
        views: numbers of input views.
        targets: target protocols by name.
        split, subjects: whose subjects, and how many, the first ones; None: all.
        metrics, device: as for :func:`ghgs_lit.evaluation.measure.measure`.
        journal: has what an earlier run measured, and gets the rest.
        identity: of all that numbers depend on beside method, views and subject.

    Returns:
        The rows of :func:`~ghgs_lit.evaluation.measure.measure`.
    """
    names = list(data.subjects(split))[:subjects]
    keys = {
        (count, subject, name): f"{identity}/{count}/{subject}/{name}"
        for count in views
        for subject in names
        for name in methods
    }
    journal.say_done(list(keys.values()), "measurements")
    with Progress() as bar:
        task, batch = bar.add_task("peers", total=len(keys)), None
        for (count, subject, name), key in keys.items():
            bar.update(task, description=f"{count} views, {subject}, {name}")
            if key not in journal:
                if batch is None or (batch.subjects, batch.images.shape[1]) != ((subject,), count):
                    batch = data.evaluation_batch(subject, split, count, list(targets.values()))
                journal.add(key, measure(methods[name], name, [batch], metrics, device))
            bar.advance(task)
    return [row for key in keys.values() for row in journal[key]]


def peer_rows(rows: Sequence[Row]) -> list[Row]:
    """Means over subjects for each number of views, method and protocol, and the median of their seconds.

    The first subject of a run also waits for kernels to be loaded.
    """
    found = by_protocol(rows)
    result = []
    for mean in summarize(rows):
        own = found[mean["method"], mean["views"], mean["targets"]].values()
        result.append({**mean, "seconds": statistics.median(subject[0]["seconds"] for subject in own)})
    return result


def tables_of(rows: Sequence[Row]) -> list[Table]:
    """A table for each protocol: number of views and method with errors and seconds a subject."""
    shown = {name: digits for name, digits in SHOWN.items() if any(name in row for row in rows)}
    header = ("views", "method", *shown, "s a subject")
    tables = []
    for protocol in dict.fromkeys(row["targets"] for row in rows):
        lines = tuple(
            (
                str(row["views"]),
                row["method"],
                *("-" if row.get(n) is None else f"{row[n]:.{digits}f}" for n, digits in shown.items()),
                f"{row['seconds']:.2f}",
            )
            for row in rows
            if row["targets"] == protocol
        )
        tables.append(Table(f"Targets: {protocol}", header, lines))
    return tables
