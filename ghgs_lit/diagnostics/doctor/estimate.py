"""What a configuration needs: operations, and the memory of prediction and of a training step, by stage.

Nothing is computed and no memory is taken for it (:mod:`ghgs_lit.diagnostics.doctor.shapes`).
"""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from ghgs_lit.config import build
from ghgs_lit.diagnostics.benchmark.flops import FlopsProbe
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.diagnostics.benchmark.stages import RENDER, TOTAL, Probe, inside, watched
from ghgs_lit.diagnostics.doctor.shapes import Shapes, without_kernels
from ghgs_lit.losses import Losses
from ghgs_lit.model import GHGS
from ghgs_lit.types import Batch, Cameras, Gaussians, Rendering, Targets

#: Stages of a training step after the prediction.
LOSS, BACKWARD = "loss", "backward"
#: Vertices of a body: those of SMPL-X.
_VERTICES = 10475


@dataclass(frozen=True)
class Scene:
    """Photographs of a subject.

    Args:
        share: part of the frame that the subject covers.
        views: number of photographs of each element.
        size: height and width in pixels.
        batch: number of elements.
        targets: photographs of each element that are rendered in a training step.
    """

    share: float
    views: int
    size: tuple[int, int]
    batch: int = 1
    targets: int = 1


@dataclass
class Pass:
    """A prediction or a training step.

    Attributes:
        flops: multiplications and additions of products, by stage.
        peaks: most bytes that are held at a time in each stage, in addition to ``held``.
        held: bytes of weights and, in training, of the optimizer's moments.
    """

    flops: dict[str, int] = field(default_factory=dict)
    peaks: dict[str, int] = field(default_factory=dict)
    held: int = 0

    @property
    def bytes(self) -> int:
        """Most bytes at a time."""
        return self.held + self.peaks[TOTAL]


class _Probe:
    """FLOPs and peaks of stages (a probe of :mod:`ghgs_lit.diagnostics.benchmark.stages`)."""

    def __init__(self, shapes: Shapes, flops: FlopsProbe):
        self.shapes, self.flops = shapes, flops
        self.peaks: dict[str, int] = {}
        self._open: list[str] = []

    def begin(self, stage: str) -> None:
        self._note()
        self._open.append(stage)
        self.flops.begin(stage)

    def end(self, stage: str) -> None:
        self.flops.end(stage)
        self._note()
        self._open.pop()

    def _note(self) -> None:
        """The peak since the last note counts for all stages that are open."""
        for stage in self._open:
            self.peaks[stage] = max(self.peaks.get(stage, 0), self.shapes.peak)
        self.shapes.restart()


def estimate_prediction(config: Mapping[str, Any], scene: Scene, device: str, precision: str) -> Pass:
    """What ``model(batch)`` needs.

    Args:
        config: of the model.
        scene: the photographs.
        device: ``cpu`` or ``cuda``: whose kernels run.
        precision: of matrix products, ``float32``, ``bfloat16`` or ``float16``.
    """
    shapes = Shapes()
    model, batch = _without_values(config, scene, shapes)
    found = Pass(held=_bytes(model.parameters()))
    with torch.no_grad(), _watched(model.eval(), shapes, device, found), _cast(precision):
        model(dataclasses.replace(batch, targets=None))
    return found


def estimate_training(config: Mapping[str, Any], scene: Scene, device: str, precision: str) -> Pass:
    """What a step of training needs, from the second one: the optimizer's moments are there.

    Args:
        config: of a run of ``ghgs train``.
        scene, device, precision: as of :func:`estimate_prediction`.
    """
    shapes = Shapes()
    model, batch = _without_values(config, scene, shapes)
    losses = build(config["loss"], "loss")
    moments = 2 * _bytes(p for p in model.parameters() if p.requires_grad)
    found = Pass(held=_bytes(model.parameters()) + moments)
    with _watched(model.train(), shapes, device, found) as probe:
        with _cast(precision):
            total = _loss(model, losses, batch, probe)
        with inside(BACKWARD, probe):
            total.backward()
    return found


def _loss(model: GHGS, losses: Losses, batch: Batch, probe: Probe) -> Tensor:
    prediction = model(batch)
    with inside(RENDER, probe):
        rendering = _rendered(prediction.gaussians, batch.targets.cameras)
    with inside(LOSS, probe):
        return losses(prediction, rendering, batch)[0]


@contextmanager
def _watched(model: GHGS, shapes: Shapes, device: str, found: Pass) -> Iterator[Probe]:
    """A probe that notes in ``found`` what the stages need; operations inside need no memory."""
    flops = FlopsProbe()
    probe = _Probe(shapes, flops)
    found.flops, found.peaks = flops.flops, probe.peaks
    # The counter of FLOPs goes last: it must see operations first.
    with (
        without_kernels(compiled=device == "cpu"),
        shapes,
        flops,
        watched(model, probe),
        inside(TOTAL, probe),
    ):
        yield probe


def _cast(precision: str) -> torch.autocast:
    """The autocast of a precision; tensors of shapes are on the CPU whatever the device."""
    is_half = precision != "float32"
    return torch.autocast("cpu", getattr(torch, precision) if is_half else torch.bfloat16, enabled=is_half)


def _without_values(config: Mapping[str, Any], scene: Scene, shapes: Shapes) -> tuple[GHGS, Batch]:
    """The model and a batch; masks and cameras have values."""
    with torch.device("meta"):
        model = GHGS.from_config(config)
    model.check_inputs = False
    with shapes.world:
        for module in model.modules():
            for name, p in module._parameters.items():
                if p is not None:
                    empty = torch.empty(p.shape, dtype=p.dtype)
                    module._parameters[name] = nn.Parameter(empty, requires_grad=p.requires_grad)
    batch = ellipsoid_batch(scene.share, scene.views, scene.size, scene.batch)
    targets = batch.targets.cameras[:, [0] * scene.targets]
    count = (scene.batch, scene.targets)
    bodies = [torch.zeros(_VERTICES, 3) for _ in range(scene.batch)]
    return model, dataclasses.replace(
        batch,
        images=shapes.empty(batch.images),
        depths=shapes.empty(torch.zeros(batch.masks.shape)),
        body_vertices=[shapes.empty(body) for body in bodies],
        targets=Targets(
            shapes.empty(torch.zeros(*count, 3, *scene.size)),
            batch.masks[:, [0] * scene.targets],
            targets,
        ),
    )


def _rendered(gaussians: Gaussians, cameras: Cameras) -> Rendering:
    """Images of a size, through which gradients go to all attributes; rasterizers keep little else."""
    names = ("means", "quaternions", "scales", "opacities", "colors")
    seen = sum(getattr(gaussians, name).sum() for name in names)
    image = seen * seen.new_zeros(*cameras.shape, 5, cameras.height, cameras.width)
    return Rendering(*image.split((3, 1, 1), dim=2))


def _bytes(tensors: Iterable[Tensor]) -> int:
    return sum(t.numel() * t.element_size() for t in tensors)
