"""Measurement of methods (models and baselines) on the targets of evaluation protocols."""

import dataclasses
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from rich.progress import track
from torch import Tensor

from ghgs_lit.geometry.unprojection import seen_surfaces
from ghgs_lit.method.recalibration.inspection import Call, collect_calls, shared_neighbors
from ghgs_lit.metrics import ImageMetrics, depth_error_mm, surface_error_mm
from ghgs_lit.refinement import CameraRefinement, Refinement
from ghgs_lit.runs.results import Row
from ghgs_lit.types import Batch, Cameras, Gaussians, Prediction, Rendering
from ghgs_lit.visualization.pictures import save_png, sheet

Renderer = Callable[[Gaussians, Cameras], Rendering]


@dataclass(frozen=True)
class Estimate:
    """Prediction of a method for a batch; None: not predicted.

    Attributes:
        image: renders of the targets, [B, T, 3, h, w].
        depth: z-depths of the input views, metres, [B, V, H, W].
        depth_valid: where ``depth`` is defined, [B, V, H, W] bool.
        gaussians: the rendered Gaussians.
        not_finite: number of Gaussians and subject depths of each element that are not finite.
        recalibrated: the recalibration with its inputs, where it has neighbours.
    """

    image: Tensor
    depth: Tensor | None = None
    depth_valid: Tensor | None = None
    gaussians: Gaussians | None = None
    not_finite: tuple[int, ...] | None = None
    recalibrated: Call | None = None


Method = Callable[[Batch], Estimate]


@dataclass(frozen=True)
class ModelMethod:
    """A model with its renderer, and optional refinement of Gaussians and cameras.

    Refined Gaussians are not at the predicted depths, so the estimate then has no depth.

    Args:
        predict: predicts a batch.
        renderer: renders Gaussians from the target cameras.
        refinement: refines the predicted Gaussians; None: no refinement.
        cameras: refines the input cameras before the prediction; None: no refinement.
    """

    predict: Callable[[Batch], Prediction]
    renderer: Renderer
    refinement: Refinement | None = None
    cameras: CameraRefinement | None = None

    def __call__(self, batch: Batch) -> Estimate:
        if self.cameras is not None:
            batch = self.cameras(batch)
        model = getattr(self.predict, "model", None)
        with collect_calls(getattr(model, "recalibration", None)) as seen:
            prediction = self.predict(batch)
        gaussians = prediction.gaussians
        depth = prediction.depth
        if self.refinement is not None:
            gaussians = self.refinement(gaussians, batch)
            depth = None
        image = self.renderer(gaussians, batch.targets.cameras).image
        valid = prediction.depth_valid
        lost = not_finite(batch, prediction)
        # The last call: downsampled images (coarse to fine) pass through the stages first.
        last = seen[-1] if seen else None
        return Estimate(image, depth, valid, gaussians, lost, last)


def not_finite(batch: Batch, prediction: Prediction) -> tuple[int, ...]:
    """Count Gaussians and depths that are not finite, and warn with the names of their subjects.

    Args:
        batch: B subjects; depths inside the masks are counted.
        prediction: the prediction for this batch.

    Returns:
        Number of non-finite Gaussians and depths of each subject.
    """
    splats = (~prediction.gaussians.is_finite).split(prediction.gaussians.splits)
    depths = (batch.masks & ~prediction.depth_valid).flatten(1).sum(1)
    counts = tuple((torch.stack([lost.sum() for lost in splats]) + depths).tolist())
    names = batch.subjects or tuple(map(str, range(len(counts))))
    lost = [f"{name}: {count}" for name, count in zip(names, counts, strict=True) if count]
    if lost:
        warnings.warn(f"Gaussians and depths that are not finite: {', '.join(lost)}", stacklevel=3)
    return counts


def _depth_error(batch: Batch, estimate: Estimate, element: int) -> float | None:
    if batch.depths is None or estimate.depth is None:
        return None
    valid = estimate.depth_valid[element] & batch.masks[element]
    return depth_error_mm(estimate.depth[element], batch.depths[element], valid).item()


def _surface_errors(batch: Batch, gaussians: Gaussians) -> list[float | None]:
    """Error of each element's Gaussians against the true surface that the input views show; None:
    unknown."""
    if batch.depths is None:
        return [None] * len(batch.images)
    splats = [gaussians[element] for element in range(len(batch.images))]
    pairs = zip(splats, seen_surfaces(batch), strict=True)
    return [surface_error_mm(own.means, own.opacities, surface).item() for own, surface in pairs]


def _make_rows(batch: Batch, estimate: Estimate, metrics: ImageMetrics) -> list[Row]:
    targets = batch.targets
    (b, t) = batch.targets.images.shape[:2]
    depths = None if targets.depths is None else targets.depths.flatten(0, 1)
    pictures = (each.flatten(0, 1) for each in (estimate.image, targets.images, targets.masks))
    flat = metrics(*pictures, depths)
    values = {name: value.reshape(b, t).tolist() for name, value in flat.items()}
    surfaces = [] if estimate.gaussians is None else _surface_errors(batch, estimate.gaussians)
    shares = [] if estimate.recalibrated is None else shared_neighbors(*estimate.recalibrated)
    rows = []
    for element in range(b):
        about = {"subject": batch.subjects[element], "views": batch.images.shape[1]}
        about["inputs"] = list(batch.views[element]) if batch.views else []
        shared = {"depth_error_mm": _depth_error(batch, estimate, element)}
        if estimate.gaussians is not None:
            shared["surface_mm"] = surfaces[element]
            shared["gaussians"] = estimate.gaussians.splits[element]
        if estimate.not_finite is not None and estimate.not_finite[element]:
            shared["not_finite"] = estimate.not_finite[element]
        if shares:
            shared["shared_neighbors"] = shares[element]
        names = targets.names[element] if targets.names else [str(k) for k in range(t)]
        for k in range(t):
            about |= {"targets": targets.protocols[k], "target": names[k]}
            rows.append({**about, **{name: value[element][k] for name, value in values.items()}, **shared})
    return rows


def _save_pictures(batch: Batch, estimate: Estimate, element: int, pictures: Path, name: str) -> None:
    """Save a picture of one subject for each protocol: inputs, depths, targets, renders and errors."""
    for protocol in dict.fromkeys(batch.targets.protocols):
        chosen = [p == protocol for p in batch.targets.protocols]
        part = dataclasses.replace(batch, targets=batch.targets.of_protocol(protocol))
        picture = sheet(part, estimate.image[:, chosen], element, estimate.depth, estimate.depth_valid)
        views = batch.images.shape[1]
        subject = batch.subjects[element]
        save_png(picture, pictures / f"{name}_v{views}_{protocol}_{subject}.png")


@torch.no_grad()
def measure(
    method: Method,
    name: str,
    loader: Iterable[Batch],
    metrics: ImageMetrics,
    device: torch.device | str = "cpu",
    pictures: Path | None = None,
    picture_count: int = 0,
) -> list[Row]:
    """Measure a method: one row for each subject and target, with one prediction for all protocols.

    Args:
        method: Predicts a batch.
        name: Name of the method in the rows.
        loader: Batches with targets.
        metrics: Metrics of images.
        device: Device of prediction and metrics.
        pictures: Folder for pictures; None: no pictures.
        picture_count: Number of subjects with pictures, from the first.

    Returns:
        Rows with method, subject, views and target, the metrics, and ``seconds``: time of the
        prediction and all renders of a batch, divided by the number of its subjects.
    """
    rows: list[Row] = []
    for batch in loader:
        batch = batch.to(device)
        started = time.perf_counter()
        estimate = method(batch)
        if estimate.image.is_cuda:
            torch.cuda.synchronize()
        seconds = (time.perf_counter() - started) / len(batch.images)
        if pictures is not None:
            for element in range(min(picture_count, len(batch.images))):
                _save_pictures(batch, estimate, element, pictures, name)
            picture_count = max(picture_count - len(batch.images), 0)
        rows += [{"method": name, **row, "seconds": seconds} for row in _make_rows(batch, estimate, metrics)]
    return rows


def measure_all(
    methods: Mapping[str, Method],
    data: LightningDataModule,
    views: Sequence[int],
    targets: Mapping[str, Mapping[str, Any]],
    split: str,
    metrics: ImageMetrics,
    device: torch.device | str = "cpu",
    pictures: Path | None = None,
    picture_count: int = 0,
) -> list[Row]:
    """Measure all methods on the same input views and targets.

    Args:
        methods: Methods by name.
        data: Provides ``evaluation_loader``.
        views: Numbers of input views, each measured separately.
        targets: Target protocols by name.
        split: Split of the data that is measured.
        metrics: Metrics of images.
        device: Device of prediction and metrics.
        pictures: Folder for pictures; None: no pictures.
        picture_count: Number of subjects with pictures, for each method and number of views.

    Returns:
        Rows as in :func:`measure`, by number of views, then protocol, then method.
    """
    rows: list[Row] = []
    for count in views:
        loader = data.evaluation_loader(views=count, targets=list(targets.values()), split=split)
        measured: list[Row] = []
        for name, method in methods.items():
            batches = track(loader, f"measuring {name}, {count} views", transient=True)
            measured += measure(method, name, batches, metrics, device, pictures, picture_count)
        for kind in targets:
            rows += [row for row in measured if row["targets"] == kind]
    return rows
