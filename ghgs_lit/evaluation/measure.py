"""Measures a method (a model or a baseline) on the targets of an evaluation protocol."""

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from ghgs_lit.data.sampling import CAMERAS, TargetProtocol
from ghgs_lit.errors import InputError
from ghgs_lit.metrics import ImageMetrics, depth_error_mm
from ghgs_lit.runs.results import Row
from ghgs_lit.types import Batch, Cameras, Gaussians, Rendering
from ghgs_lit.visualization.pictures import save_png, sheet

Renderer = Callable[[Gaussians, Cameras], Rendering]


@dataclass(frozen=True)
class Estimate:
    """What a method says about a batch: target images [B, T, 3, h, w]; depths [B, V, H, W] if it has any."""

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
    """The numbers of each element's targets, without what the row is about."""
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
    """One row for each subject and target of ``loader``; the first subjects' pictures go to ``pictures``.

    ``seconds`` is the time of a subject's prediction and renders, on the device as it is used here.
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
    methods: dict[str, Method],
    data,
    views: Sequence[int],
    targets: Sequence[str],
    split: str,
    metrics: ImageMetrics,
    device: torch.device | str = "cpu",
    pictures: Path | None = None,
    picture_count: int = 0,
) -> list[Row]:
    """Every method on every number of views and kind of target, on the same subjects and photographs."""
    rows: list[Row] = []
    for count in views:
        for kind in targets:
            known = {CAMERAS.name: CAMERAS, data.targets.name: data.targets}
            protocol = known.get(kind) or TargetProtocol(kind)
            loader = data.evaluation_loader(views=count, targets=protocol, split=split)
            for name, method in methods.items():
                rows += measure(method, name, loader, kind, metrics, device, pictures, picture_count)
    return rows
