"""Training steps that are captured on a GPU for each shape bucket, and replayed.

A step of a small model needs thousands of launches, which take the host longer than the GPU needs to
run them. As in predictions, shapes after the plan depend on its sizes alone. So the stages, the
rendering, the loss and the gradients of all weights are one CUDA graph. The plan before it is made
eagerly, and so is everything after it: hooks of weights, clipping and the optimizer get a loss with a
gradient as usual."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.func import functional_call

from ghgs_lit.execution.graphs import GraphCache
from ghgs_lit.execution.predictor import Predictor, Prepared
from ghgs_lit.execution.preprocessing import Preprocessing, Scene
from ghgs_lit.geometry.precision import precision_of
from ghgs_lit.losses import Losses
from ghgs_lit.method.plan import Sizes
from ghgs_lit.method.plan.window import Span, Window
from ghgs_lit.rendering.api import Renderer
from ghgs_lit.types import Batch


class Outcome(NamedTuple):
    """Result of a training step's forward pass.

    Attributes:
        total: the loss, a scalar with a gradient.
        values: its unweighted terms by name.
        gaussians: number of Gaussians of the batch.
    """

    total: Tensor
    values: dict[str, Tensor]
    gaussians: int


class _Known(torch.autograd.Function):
    """Attaches known gradients to a loss: ``apply(total, gradients, *weights)``."""

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
    """Stages, rendering and loss as one module, for ``functional_call`` with other weights."""

    def __init__(self, predictor: Predictor, renderer: Renderer, losses: Losses):
        super().__init__()
        self.predictor = predictor
        self.model = predictor.model
        self.renderer = renderer
        self.losses = losses

    def forward(self, scene: Scene, done: Preprocessing, seen: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the loss and its terms; Gaussians that pad a bucket are rendered, too, with opacity 0.

        Args:
            scene: the preprocessed batch and its plan.
            done: its preprocessing.
            seen: the original batch, with targets.
        """
        with precision_of(self.predictor.precision, seen.masks.device):
            prediction = done.undo(self.model(*scene.read()))
        rendering = self.renderer(prediction.gaussians, seen.targets.cameras)
        return self.losses(prediction, rendering, seen)


class CapturedStep:
    """``step(batch) -> Outcome``: the forward pass of a training step, captured if possible.

    Args:
        predictor: contains the model.
        renderer: renderer of the training; only this package's is captured, since others may depend on
            values of tensors.
        losses: likewise.

    Attributes:
        graphs: captured graphs, one per shape bucket.
        buckets: sizes so far, by the shape of input views and the encoder's choice of patches. Sizes are
            reused as long as the subjects of a batch fit, so that few buckets must be captured.
    """

    def __init__(self, predictor: Predictor, renderer: Callable, losses: Callable):
        self.predictor = predictor
        self.renderer = renderer
        self.losses = losses
        self.graphs = GraphCache(limit=16)
        self.buckets: dict[tuple, Sizes] = {}

    def captures(self, batch: Batch, is_scaled: bool = False) -> bool:
        """Whether to try to capture a training step.

        Requires a device with capture, ``model.capture=auto``, no renderer or term of the loss of a
        plug-in, no tokens read from disk, and under float16 autocast a scaled loss (``is_scaled``).
        """
        device = batch.masks.device.type
        model = self.predictor.model
        known = isinstance(self.renderer, Renderer) and isinstance(self.losses, Losses)
        known = known and not self.losses.weights.model_extra
        is_on = self.predictor.options.capture == "auto" and device == self.graphs.backend.device
        if not (known and is_on and model.training):
            return False
        # A plug-in's encoder may not have the attribute.
        reads_disk = getattr(model.encoder, "keeps_features", False)
        is_half = torch.is_autocast_enabled(device) and torch.get_autocast_dtype(device) == torch.float16
        return not reads_disk and (is_scaled or not is_half)  # gradients would underflow

    def __call__(self, batch: Batch, scale: Tensor | None = None) -> Outcome:
        """Run the forward pass of a training step, replayed from the third batch of a bucket on.

        Batches with tall subjects or without a bucket, and models with hooks, run eagerly.

        Args:
            batch: on the device of the training, with targets; :meth:`captures` holds.
            scale: scalar factor of the loss (``16-mixed``); None: 1.
        """
        predictor = self.predictor
        with predictor.model.rounds.fix_count():
            prepared = self._prepare(batch)
            is_eager = prepared.state is None or not predictor.fits(prepared.batch, prepared.plan)
            if is_eager or predictor.needs_copies(prepared.batch):
                prediction = predictor.finish(prepared)
                rendering = self.renderer(prediction.gaussians, batch.targets.cameras)
                return Outcome(*self.losses(prediction, rendering, batch), len(prediction.gaussians))
            targets = dataclasses.replace(batch.targets, names=(), protocols=())
            bodies = batch.body_vertices if self.losses.weights.chamfer else None
            seen = dataclasses.replace(batch, targets=targets, body_vertices=bodies, subjects=(), views=())
            return self._capture(prepared, seen, scale)

    def _prepare(self, batch: Batch) -> Prepared:
        """Preprocess and plan a batch, with sizes that rarely change."""
        shape = tuple(batch.masks.shape)
        encoder = self.predictor.model.encoder
        view = (*shape, encoder.tokens, encoder.margin)
        least = self.buckets.get(shape)
        if least is not None:
            least = dataclasses.replace(least, kept=self.buckets[view].kept if view in self.buckets else 0)
        prepared = self.predictor.prepare(batch, least)
        if prepared.plan.is_bucket:
            self.buckets[shape] = self.buckets[view] = prepared.plan.sizes
        return prepared

    def _capture(self, prepared: Prepared, seen: Batch, scale: Tensor | None) -> Outcome:
        """Compute the loss with gradients from a captured graph; ``seen`` is the original batch."""
        one_pass = _Pass(self.predictor, self.renderer, self.losses)
        weights = {name: weight for name, weight in one_pass.named_parameters() if weight.requires_grad}

        def compute_gradients(inputs: tuple) -> tuple[Tensor, dict[str, Tensor], tuple]:
            *inputs, scale = inputs
            # Twins: gradients of the weights themselves would be accumulated on another stream.
            twins = {name: weight.detach().requires_grad_() for name, weight in weights.items()}
            with torch.enable_grad():
                total, values = functional_call(one_pass, twins, tuple(inputs))
                gradients = _differentiate(total, list(twins.values()), scale)
            gradients = tuple(map(_match_layout, gradients, weights.values()))
            return total.detach(), {name: value.detach() for name, value in values.items()}, gradients

        self.graphs.of_weights(prepared.state)
        inputs = (Scene.of(prepared.batch, prepared.plan), prepared.done, seen, scale)
        key = (
            prepared.state.settings,
            self.predictor.precision,
            repr((self.renderer, self.losses)),
            tuple(weights),
        )
        with torch.no_grad():
            total, values, gradients = self.graphs.repeat_until_sufficient(compute_gradients, inputs, key)
        used = [pair for pair in zip(weights.values(), gradients, strict=True) if pair[1] is not None]
        known = _Known.apply(total, [gradient for _, gradient in used], *[weight for weight, _ in used])
        return Outcome(known, values, sum(prepared.plan.counts))

    def state_dict(self) -> list[tuple[tuple, tuple]]:
        """Shape buckets as plain data: a resumed run with the same buckets computes the same."""
        return [(key, _plain(sizes)) for key, sizes in self.buckets.items()]

    def load_state_dict(self, state: Sequence[tuple[tuple, tuple]]) -> None:
        """Restore the shape buckets of :meth:`state_dict`."""
        for key, (*rows, window) in state:
            self.buckets[tuple(key)] = Sizes(*rows, Window(*(Span(*span) for span in window)))


def _plain(sizes: Sizes) -> tuple:
    *rows, window = (getattr(sizes, field.name) for field in dataclasses.fields(sizes))
    return *rows, tuple(map(tuple, window))


def _differentiate(total: Tensor, weights: Sequence[Tensor], scale: Tensor | None) -> list[Tensor | None]:
    """Gradients of a loss for each weight, None for unused ones; computed on ``scale * total`` and divided
    by ``scale``, against underflow in float16."""
    with torch.autocast(total.device.type, enabled=False):
        if scale is None:
            return list(torch.autograd.grad(total, weights, allow_unused=True))
        gradients = list(torch.autograd.grad(total * scale, weights, allow_unused=True))
        used = [number for number, gradient in enumerate(gradients) if gradient is not None]
        unscaled = torch._foreach_mul([gradients[number] for number in used], 1 / scale)
        for number, gradient in zip(used, unscaled, strict=True):
            gradients[number] = gradient
        return gradients


def _match_layout(gradient: Tensor | None, weight: Tensor) -> Tensor | None:
    """Convert a gradient to the layout of its weight; otherwise PyTorch would copy each separately."""
    if gradient is None or gradient.stride() == weight.stride():
        return gradient
    return torch.empty_like(weight).copy_(gradient)
