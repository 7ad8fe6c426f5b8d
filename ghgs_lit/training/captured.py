"""Training steps whose work is recorded on a GPU for each class of batches, and played back.

A step of a small model asks a GPU for thousands of launches, and the host takes longer to ask than
the GPU to do. What follows a plan depends on sizes alone, in training as in predictions
(:mod:`ghgs_lit.method.playback`). So the stages, the rendering, the loss and the gradients of all weights
are one CUDA graph here. What surrounds it is called as always: the plan before it; hooks of
weights, clipping and the optimizer after it, which find a loss with a gradient as usual."""

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from ghgs_lit.losses import Losses
from ghgs_lit.method.model import GHGS
from ghgs_lit.method.plan import Plan
from ghgs_lit.method.playback import Scene
from ghgs_lit.rendering.api import Renderer
from ghgs_lit.rendering.capacity import Rooms, deferred
from ghgs_lit.runtime.watching import is_watched
from ghgs_lit.surroundings import Surrounding, left
from ghgs_lit.types import Batch, Prediction


class Outcome(NamedTuple):
    """Of a forward pass.

    Attributes:
        total: the loss, without dimensions, with a gradient.
        values: its unweighted terms by name.
        gaussians: number of Gaussians of the batch.
    """

    total: Tensor
    values: dict[str, Tensor]
    gaussians: int


class _Known(torch.autograd.Function):
    """A loss whose gradients are known: ``apply(total, gradients, *weights)``."""

    @staticmethod
    def forward(ctx: Any, total: Tensor, gradients: Sequence[Tensor], *weights: nn.Parameter) -> Tensor:
        ctx.gradients = gradients
        return total.clone()

    @staticmethod
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        gradients = ctx.gradients
        del ctx.gradients
        return None, None, *torch._foreach_mul(gradients, slope)


class _Pass(nn.Module):
    """Stages, rendering and loss, of a batch that is prepared;
    its weights can be replaced by others.

    Args:
        model: of the training.
        renderer: draws its Gaussians.
        losses: compares them.
    """

    def __init__(self, model: GHGS, renderer: Renderer, losses: Losses):
        super().__init__()
        self.model = model
        self.renderer = renderer
        self.losses = losses

    def forward(
        self, around: Sequence[Surrounding], batch: Batch, plan: Plan, seen: Batch
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss and its terms. Gaussians that fill a size class are drawn, too, with opacity 0.

        Args:
            around: layers around the stages.
            batch: inside of them.
            plan: of the batch.
            seen: the batch outside of them, with targets.
        """
        prediction = self._predicted(around, batch, plan)
        rendering = self.renderer(prediction.gaussians, seen.targets.cameras)
        return self.losses(prediction, rendering, seen)

    def _predicted(self, around: Sequence[Surrounding], batch: Batch, plan: Plan) -> Prediction:
        with self.model.in_precision(batch.masks.device):
            return left(around, self.model.predict(batch, plan))


def may_be_recorded(model: nn.Module, renderer: Callable, losses: Callable, device: str) -> bool:
    """Whether steps of a training are of a kind that is recorded.

    Args:
        model: of the training.
        renderer: of the training; others than this package's may do what depends on values.
        losses: likewise.
        device: its type.
    """
    known = isinstance(model, GHGS) and isinstance(renderer, Renderer) and isinstance(losses, Losses)
    known = known and not losses.weights.model_extra  # terms of a plug-in may do likewise
    return known and model.options.capture == "auto" and device == model.playback.steps.tape.device


def is_recordable(
    model: nn.Module, renderer: Callable, losses: Callable, batch: Batch, is_scaled: bool = False
) -> bool:
    """Whether a training step can be recorded.

    Args:
        model: as of :func:`may_be_recorded`.
        renderer: as of :func:`may_be_recorded`.
        losses: as of :func:`may_be_recorded`.
        batch: of a step.
        is_scaled: whether the loss has a factor.

    Returns:
        True on a device that records, with ``model.capture=auto``, where no tokens are read from
        disk, and a loss with float16 has a factor.
    """
    device = batch.masks.device.type
    if not may_be_recorded(model, renderer, losses, device) or is_watched():
        return False
    if getattr(model.encoder, "keeps_features", False):  # a plug-in's may not say
        return False
    is_half = torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device) == torch.float16
    if is_half and not is_scaled:
        return False  # gradients would underflow
    return model.training


def played(
    model: GHGS, renderer: Renderer, losses: Losses, batch: Batch, scale: Tensor | None = None
) -> Outcome:
    """The forward pass of a training step, played back from the third batch of a class on.

    A batch whose subjects are tall, or whose sizes are no class, is called operator by operator.

    Args:
        model: of the training.
        renderer: of the training.
        losses: of the training.
        batch: on the device of the training, with targets; :func:`is_recordable`.
        scale: factor of the loss (``16-mixed``), without dimensions; None: 1.
    """
    with nullcontext() if model.rounds is None else model.rounds.drawn():
        around, inside, plan = _prepared(model, batch)
        if not model.playback.repeats(inside, plan) or model.needs_copies(inside):
            prediction = model.finished(around, inside, plan)
            rendering = renderer(prediction.gaussians, batch.targets.cameras)
            return Outcome(*losses(prediction, rendering, batch), len(prediction.gaussians))
        targets = dataclasses.replace(batch.targets, names=(), protocols=())
        bodies = batch.body_vertices if losses.weights.chamfer else None
        seen = dataclasses.replace(batch, targets=targets, body_vertices=bodies, subjects=(), views=())
        one_pass = _Pass(model, renderer, losses)
        return _recorded(one_pass, around, Scene.of(inside, plan), seen, sum(plan.counts), scale)


def _prepared(model: GHGS, batch: Batch) -> tuple[Sequence[Surrounding], Batch, Plan]:
    """What precedes the stages, with a plan of sizes that rarely change.

    Subjects of other batches are of other sizes, and each class would have to be recorded. So sizes
    are kept as long as they are enough for the subjects of a batch.

    Args:
        model: of the training.
        batch: of a step.
    """
    sizes = model.playback.sizes
    shape = tuple(batch.masks.shape)
    view = (shape, model.encoder.tokens, model.encoder.margin)
    least = sizes.get(shape)
    if least is not None:
        least = dataclasses.replace(least, kept=sizes[view].kept if view in sizes else 0)
    around, inside, plan = model.prepared(batch, least)
    if plan.is_of_class:
        sizes[shape] = sizes[view] = plan.sizes
    return around, inside, plan


def _differentiated(total: Tensor, weights: Sequence[Tensor], scale: Tensor | None) -> list[Tensor | None]:
    """Gradients of a loss, of float16 as large as those of its multiple.

    Args:
        total: the loss.
        weights: of which some may take no part.
        scale: factor of the loss; None: 1.

    Returns:
        The gradient of the loss itself for each weight.
    """
    with torch.autocast(total.device.type, enabled=False):
        if scale is None:
            return list(torch.autograd.grad(total, weights, allow_unused=True))
        gradients = list(torch.autograd.grad(total * scale, weights, allow_unused=True))
        used = [number for number, gradient in enumerate(gradients) if gradient is not None]
        unscaled = torch._foreach_mul([gradients[number] for number in used], 1 / scale)
        for number, gradient in zip(used, unscaled, strict=True):
            gradients[number] = gradient
        return gradients


def _laid_out(gradient: Tensor | None, weight: Tensor) -> Tensor | None:
    """A gradient in the layout of its weight: PyTorch would copy others, one by one."""
    if gradient is None or gradient.stride() == weight.stride():
        return gradient
    return torch.empty_like(weight).copy_(gradient)


def _recorded(
    one_pass: _Pass,
    around: Sequence[Surrounding],
    scene: Scene,
    seen: Batch,
    gaussians: int,
    scale: Tensor | None,
) -> Outcome:
    """The loss, whose gradients come from a recording.

    Args:
        one_pass: what is recorded.
        around: layers around the stages.
        scene: the batch inside of them.
        seen: the batch outside of them, without names.
        gaussians: their number.
        scale: factor of the loss; None: 1.
    """
    weights = {name: weight for name, weight in one_pass.named_parameters() if weight.requires_grad}

    def differentiated(inputs: tuple) -> tuple[Tensor, dict[str, Tensor], tuple, Rooms]:
        around, scene, seen, scale = inputs
        # Gradients of the weights themselves would be summed on the stream that first
        # asked for them.
        twins = {name: weight.detach().requires_grad_() for name, weight in weights.items()}
        with torch.enable_grad(), deferred() as rooms:
            total, values = functional_call(one_pass, twins, (around, *scene.read(), seen))
            gradients = _differentiated(total, list(twins.values()), scale)
        gradients = tuple(map(_laid_out, gradients, weights.values()))
        return total.detach(), {name: value.detach() for name, value in values.items()}, gradients, rooms

    recorder = one_pass.model.playback.steps
    inputs = (tuple(around), scene, seen, scale)
    key = (one_pass.model.settings(), repr((one_pass.renderer, one_pass.losses)), tuple(weights))
    with torch.no_grad():
        total, values, gradients, rooms = recorder(differentiated, inputs, key)
        while not rooms.suffice():
            recorder.forget(inputs, key)
            total, values, gradients, rooms = recorder(differentiated, inputs, key)
    used = [pair for pair in zip(weights.values(), gradients, strict=True) if pair[1] is not None]
    known = _Known.apply(total, [gradient for _, gradient in used], *[weight for weight, _ in used])
    return Outcome(known, values, gaussians)
