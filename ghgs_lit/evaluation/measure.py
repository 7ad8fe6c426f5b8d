"""Measures a method (a model or a baseline) on the targets of an evaluation protocol."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor, nn

from ghgs_lit.errors import InputError
from ghgs_lit.metrics import ImageMetrics, depth_error_mm
from ghgs_lit.runs.progress import track
from ghgs_lit.runs.results import Row
from ghgs_lit.types import Batch, Cameras, Gaussians, Rendering
from ghgs_lit.visualization.pictures import save_png, sheet

Renderer = Callable[[Gaussians, Cameras], Rendering]


@dataclass(frozen=True)
class Estimate:
    """What a method predicts for a batch; None where it does not predict it.

    Args:
        image: renders of the targets [B, T, 3, h, w].
        depth: depths of the inputs [B, V, H, W], metres.
        depth_valid: where they are defined [B, V, H, W].
        gaussians: number of Gaussians of each element [B].
    """

    image: Tensor
    depth: Tensor | None = None
    depth_valid: Tensor | None = None
    gaussians: tuple[int, ...] | None = None


Method = Callable[[Batch], Estimate]


@dataclass(frozen=True)
class ModelMethod:
    """A model and the renderer of its Gaussians."""

    model: nn.Module
    renderer: Renderer

    def __call__(self, batch: Batch) -> Estimate:
        prediction = self.model(batch)
        rendering = self.renderer(prediction.gaussians, batch.targets.cameras)
        return Estimate(
            rendering.image, prediction.depth, prediction.depth_valid, prediction.gaussians.splits
        )


def _depth_error(batch: Batch, estimate: Estimate, element: int) -> float | None:
    if batch.depths is None or estimate.depth is None:
        return None
    valid = estimate.depth_valid[element] & batch.masks[element]
    return depth_error_mm(estimate.depth[element], batch.depths[element], valid).item()


def _rows(batch: Batch, estimate: Estimate, metrics: ImageMetrics) -> list[list[Row]]:
    """The metrics of each element's targets [B][T], without what the rows describe."""
    b, t = batch.targets.images.shape[:2]
    flat = metrics(
        estimate.image.flatten(0, 1), batch.targets.images.flatten(0, 1), batch.targets.masks.flatten(0, 1)
    )
    values = {name: value.reshape(b, t).tolist() for name, value in flat.items()}
    rows = []
    for element in range(b):
        shared = {"depth_error_mm": _depth_error(batch, estimate, element)}
        if estimate.gaussians is not None:
            shared["gaussians"] = estimate.gaussians[element]
        rows.append([{**{name: v[element][k] for name, v in values.items()}, **shared} for k in range(t)])
    return rows


@torch.no_grad()
def measure(
    method: Method,
    name: str,
    loader: Iterable[Batch],
    targets: str,
    metrics: ImageMetrics,
    device: torch.device | str = "cpu",
    pictures: Path | None = None,
    picture_count: int = 0,
) -> list[Row]:
    """Measure one method on one protocol.

    Args:
        method: what is measured.
        name: its name in the rows.
        loader: batches with targets.
        targets: name of the target protocol in the rows.
        metrics: what is computed of the renders.
        device: where the method runs.
        pictures: folder for pictures (None: none are written).
        picture_count: the number of subjects, the first ones, that are drawn.

    Returns:
        One row for each subject and target. ``seconds`` is the time of the prediction and the renders of a
        subject, in a batch as the loader gives it.

    Raises:
        InputError: a batch has no targets.
    """
    rows: list[Row] = []
    for batch in loader:
        batch = batch.to(device)
        if batch.targets is None:
            raise InputError(f"evaluation.targets={targets}: expected target photographs; found none")
        started = time.perf_counter()
        estimate = method(batch)
        if estimate.image.is_cuda:
            torch.cuda.synchronize()
        seconds = (time.perf_counter() - started) / len(batch.images)
        views = batch.images.shape[1]
        for element, numbers in enumerate(_rows(batch, estimate, metrics)):
            subject = batch.subjects[element]
            if pictures is not None and picture_count > 0:
                picture_count -= 1
                picture = sheet(batch, estimate.image, element, estimate.depth, estimate.depth_valid)
                save_png(picture, pictures / f"{name}_v{views}_{targets}_{subject}.png")
            for k, own in enumerate(numbers):
                about = {
                    "method": name,
                    "subject": subject,
                    "views": views,
                    "targets": targets,
                    "target": batch.targets.names[element][k] if batch.targets.names else str(k),
                    "inputs": list(batch.views[element]) if batch.views else [],
                }
                rows.append({**about, **own, "seconds": seconds})
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
    """Measure all methods on the same subjects and photographs.

    Args:
        methods: what is measured, by name.
        data: gives the photographs (``evaluation_loader``).
        views: numbers of input views.
        targets: target protocols by name.
        split: subjects of ``train`` or ``val``.
        metrics, device, pictures, picture_count: as for :func:`measure`; pictures of each protocol.

    Returns:
        The rows of every number of views, protocol and method, in this order.
    """
    rows: list[Row] = []
    for count in views:
        for kind, protocol in targets.items():
            loader = data.evaluation_loader(views=count, targets=protocol, split=split)
            for name, method in methods.items():
                batches = track(loader, f"measuring {name}, {count} views, targets {kind}")
                rows += measure(method, name, batches, kind, metrics, device, pictures, picture_count)
    return rows
