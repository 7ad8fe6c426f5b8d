"""A model beside what a user would pick instead: the same people and targets, error and seconds a subject."""

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
import torch

from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.diagnostics.output import Tables, texts
from ghgs_lit.evaluation.measure import Method, measure
from ghgs_lit.metrics import ImageMetrics
from ghgs_lit.runs.journal import Journal
from ghgs_lit.runs.progress import track
from ghgs_lit.runs.results import Row, summarize

#: What rows with the same protocol agree in.
_PROTOCOL = ["method", "views", "targets"]
#: Headings of a table, with columns and formats.
_COLUMNS = {
    "views": ("views", "{}"),
    "method": ("method", "{}"),
    "psnr": ("psnr", "{:.2f}"),
    "psnr_box": ("psnr_box", "{:.2f}"),
    "ssim": ("ssim", "{:.4f}"),
    "flip": ("flip", "{:.4f}"),
    "depth_error_mm": ("depth_error_mm", "{:.1f}"),
    "s a subject": ("seconds", "{:.2f}"),
}


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
        split, subjects: whose subjects, and how many, the first ones; None: all.
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
    batch = None
    for (count, subject, name), key in track(keys.items(), "views, subjects and methods"):
        if key not in journal:
            if batch is None or (batch.subjects, batch.images.shape[1]) != ((subject,), count):
                batch = data.evaluation_batch(subject, split, count, list(targets.values()))
            journal.add(key, measure(methods[name], name, [batch], metrics, device))
    return [row for key in keys.values() for row in journal[key]]


def peer_rows(rows: Sequence[Row]) -> list[Row]:
    """Means over subjects for each number of views, method and protocol, and the median of their seconds.

    The first subject of a run also waits for kernels to be loaded.
    """
    subjects = pd.DataFrame(rows).groupby([*_PROTOCOL, "subject"]).seconds.first()
    seconds = subjects.groupby(_PROTOCOL).median()
    return [
        {**mean, "seconds": float(seconds[*(mean[key] for key in _PROTOCOL)])} for mean in summarize(rows)
    ]


def tables_of(rows: Sequence[Row]) -> Tables:
    """A table for each protocol: number of views and method with errors and seconds a subject."""
    groups = pd.DataFrame(rows).groupby("targets", sort=False)
    return {f"Targets: {protocol}": texts(group, _COLUMNS) for protocol, group in groups}
