"""What a configuration needs, by stage: parameters, operations, memory; none is taken for the estimate."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any
from unittest import mock

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ghgs_lit.bounds import cpu as bounds
from ghgs_lit.config import build
from ghgs_lit.diagnostics.benchmark.error import ATTRIBUTES
from ghgs_lit.diagnostics.benchmark.flops import FlopsProbe
from ghgs_lit.diagnostics.benchmark.memory import PeakProbe
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.diagnostics.benchmark.stages import RENDER, TOTAL, watched
from ghgs_lit.diagnostics.benchmark.weights import filled_model
from ghgs_lit.diagnostics.doctor.shapes import Shapes
from ghgs_lit.encoder import cpu as encoder
from ghgs_lit.geometry import chamfer
from ghgs_lit.geometry import cpu as geometry
from ghgs_lit.heads import cpu as heads
from ghgs_lit.heads import gaussian
from ghgs_lit.kernels.watching import Inputs, Watcher, inside
from ghgs_lit.losses import Losses
from ghgs_lit.model import GHGS, HEADS
from ghgs_lit.types import Batch, Cameras, Gaussians, Rendering, Targets

#: Stages of a training step after the prediction.
LOSS, BACKWARD = "loss", "backward"
#: Vertices of a body: those of SMPL-X.
_VERTICES = 10475


@dataclass(frozen=True)
class Scene:
    """Photographs of a subject that covers ``share`` of the frame: ``views`` of each of ``batch`` elements,
    of ``size`` (height, width), and ``targets`` that are rendered in a training step."""

    share: float
    views: int
    size: tuple[int, int]
    batch: int = 1
    targets: int = 1


@dataclass(frozen=True)
class Pass:
    """A prediction or a training step.

    Attributes:
        flops: multiplications and additions of products, by stage.
        peaks: most bytes that are held at a time in each stage, in addition to ``held``.
        held: bytes of weights and, in training, of the optimizer's moments.
    """

    flops: dict[str, int]
    peaks: dict[str, int]
    held: int

    @property
    def bytes(self) -> int:
        """Most bytes at a time."""
        return self.held + self.peaks[TOTAL]


def parameters(config: Mapping[str, Any]) -> dict[str, tuple[int, int]]:
    """Numbers of parameters, and of those that are trained, of each stage with weights and of the whole
    ``model``, last."""
    with torch.device("meta"):
        model = GHGS.from_config(config)
    parts = {name: getattr(model, name) for name in ("encoder", *HEADS)} | {"model": model}
    return {name: (_count(part, False), _count(part, True)) for name, part in parts.items()}


def _count(part: nn.Module, trained: bool) -> int:
    return sum(p.numel() for p in part.parameters() if p.requires_grad or not trained)


class _Needs(PeakProbe):
    """FLOPs and peaks of stages on tensors without values."""

    is_available = True

    def __init__(self, shapes: Shapes, flops: FlopsProbe):
        super().__init__(torch.device("cpu"))
        self.shapes, self.flops = shapes, flops

    def begin(self, stage: str, inputs: Inputs = ((), {})) -> None:
        super().begin(stage)
        self.flops.begin(stage)

    def end(self, stage: str, result: Any = None) -> None:
        self.flops.end(stage)
        super().end(stage)

    def held(self) -> int:
        return self.shapes.live

    def peak(self) -> int:
        return self.shapes.peak

    def reset(self) -> None:
        self.shapes.peak = self.shapes.live


def estimate(
    config: Mapping[str, Any], scene: Scene, device: str, precision: str, training: bool = False
) -> Pass:
    """What ``model(batch)`` needs, or a step of training from the second one: the moments are there.

    Args:
        config: of the model; for training, of a run of ``ghgs train``.
        device: ``cpu`` or ``cuda``: whose kernels run.
        precision: of matrix products, ``float32``, ``bfloat16`` or ``float16``.
    """
    shapes, flops = Shapes(), FlopsProbe()
    model = filled_model(config, lambda _, parameter: shapes.of(parameter.shape))
    model.train(training).checks_values = False
    batch, needs = _batch(scene, shapes), _Needs(shapes, flops)
    half = precision != "float32"
    # Tensors without values are on the CPU, whatever the device.
    cast = torch.autocast("cpu", getattr(torch, precision) if half else torch.bfloat16, enabled=half)
    with ExitStack() as stack:
        # The counter of FLOPs goes last: it must see operations first.
        for context in (torch.set_grad_enabled(training), _kernels(device), shapes, flops):
            stack.enter_context(context)
        with watched(model, needs), inside(TOTAL, needs):
            if training:
                _step(model, build(config["loss"], "loss"), batch, needs, cast)
            else:
                with cast:
                    model(dataclasses.replace(batch, targets=None))
    moments = 2 * _bytes(p for p in model.parameters() if p.requires_grad) if training else 0
    return Pass(flops.flops, needs.peaks, _bytes(model.parameters()) + moments)


def _step(model: GHGS, losses: Losses, batch: Batch, needs: Watcher, cast: torch.autocast) -> None:
    with cast:
        prediction = model(batch)
        with inside(RENDER, needs):
            rendering = _rendered(prediction.gaussians, batch.targets.cameras)
        with inside(LOSS, needs):
            total = losses(prediction, rendering, batch)[0]
        del prediction, rendering
    with inside(BACKWARD, needs):
        total.backward()


def _rendered(gaussians: Gaussians, cameras: Cameras) -> Rendering:
    """Images of a size, through which gradients go to all attributes; rasterizers keep little else."""
    seen = sum(getattr(gaussians, name).sum() for name in ATTRIBUTES)
    image = seen * seen.new_zeros(*cameras.shape, 5, cameras.height, cameras.width)
    return Rendering(*image.split((3, 1, 1), dim=2))


@contextmanager
def _kernels(device: str) -> Iterator[None]:
    """The shapes of the results of compiled kernels; PyTorch's own operators where ``device`` has none."""
    results = [
        (encoder, "attend", lambda q, k, v: v.new_empty(q.transpose(1, 2).shape)),
        (geometry, "padded", lambda photo, masks: photo.new_empty(4 * F.pad(masks, (1, 1, 1, 1)).numel())),
        (geometry, "sweep", lambda colors, pixels, *rest: colors.new_empty(len(pixels), len(rest[-2]))),
        (heads, "is_supported", lambda *_: False),
        (gaussian, "multiplies", lambda *_: False),
        (chamfer, "nearest", lambda queries, _: torch.zeros(len(queries), dtype=torch.long)),
    ]
    if device != "cpu":
        results += [(module, "is_supported", lambda *_: False) for module in (bounds, encoder, geometry)]
    with ExitStack() as stack:
        for module, name, result in results:
            stack.enter_context(mock.patch.object(module, name, result))
        yield


def _batch(scene: Scene, shapes: Shapes) -> Batch:
    """A batch whose masks and cameras have values, and nothing else."""
    batch = ellipsoid_batch(scene.share, scene.views, scene.size, scene.batch)
    target, empty = [0] * scene.targets, shapes.empty
    return dataclasses.replace(
        batch,
        images=empty(batch.images),
        depths=shapes.of(batch.masks.shape),
        body_vertices=[shapes.of((_VERTICES, 3)) for _ in range(scene.batch)],
        targets=Targets(
            empty(batch.images[:, target]), batch.masks[:, target], batch.targets.cameras[:, target]
        ),
    )


def _bytes(tensors: Iterable[Tensor]) -> int:
    return sum(t.numel() * t.element_size() for t in tensors)
