"""Compare replays of CUDA graphs with eager calls, for inputs that were not captured."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, replace
from typing import Any

import torch
from torch import Tensor, nn

from benchmarks.gpu_measure import Call
from ghgs_lit.execution import Predictor
from ghgs_lit.execution.graphs import GraphCache
from ghgs_lit.types import Batch

#: Largest distance of results that differ by rounding; or ten times that of two eager calls, if larger.
ROUNDING = 1e-3
WRONG = "WRONG"


def other_scene(batch: Batch) -> Batch:
    """A batch of the same shape bucket, with other colours, in a world that is shifted by 20 cm."""
    extrinsics = batch.cameras.extrinsics.clone()
    extrinsics[..., :3, 3] += 0.2 * extrinsics[..., :3, 0]
    return replace(batch, images=0.6 * batch.images, cameras=replace(batch.cameras, extrinsics=extrinsics))


def relative_distance(found: Sequence[Tensor], wanted: Sequence[Tensor]) -> float:
    """Largest relative distance between tensors.

    Each is relative to the norm of the wanted tensor, or to a thousandth of the largest norm: small
    gradients are only rounding errors.
    """
    sizes = [other.norm().item() for other in wanted]
    least = 1e-3 * max(sizes)
    distances = [(one - other).norm() for one, other in zip(found, wanted, strict=True)]
    shares = [distance / max(size, least) for distance, size in zip(distances, sizes, strict=True)]
    return float(torch.stack(shares).max())  # nan propagates


def judge(call: Call, name: str, cache: GraphCache, run: Callable[[bool], list[Tensor]]) -> None:
    """Add a row that compares a replayed call with two eager ones.

    Args:
        call: of the section.
        name: of the row.
        cache: graph cache with captured calls of this shape bucket.
        run: returns results on the CPU of a call that may be replayed (True) or is eager (False).
    """
    before = cache.counts["replayed"]
    found, wanted, again = (run(may_replay) for may_replay in (True, False, False))
    numbers = {"apart": relative_distance(found, wanted), "noise": relative_distance(again, wanted)}
    # False for nan.
    holds = numbers["apart"] <= max(ROUNDING, 10 * numbers["noise"])
    is_replayed = cache.counts["replayed"] > before
    verdict = ("as eager" if holds else WRONG) if is_replayed else "not replayed"
    call.add(f"{name}, replay beside eager", verdict=verdict, **numbers)


def copy_to_cpu(tensors: Iterable[Tensor]) -> list[Tensor]:
    """Copies on the CPU, in float64."""
    return [tensor.detach().cpu().double() for tensor in tensors]


@torch.no_grad()
def judge_prediction(call: Call, name: str, predictor: Predictor, batch: Batch) -> None:
    """Add a row for a prediction of another scene.

    Args:
        call: of the section.
        name: of the row.
        predictor: with captured predictions of this shape bucket.
        batch: of the shape bucket, on the device.
    """
    other, options = other_scene(batch), predictor.options

    def predict_other(may_replay: bool) -> list[Tensor]:
        capture = "auto" if may_replay else "off"
        predictor.options = options.replace(capture=capture)
        gaussians = predictor(other).gaussians
        values = [getattr(gaussians, field.name) for field in fields(gaussians)]
        return copy_to_cpu(x for x in values if isinstance(x, Tensor) and x.is_floating_point())

    judge(call, name, predictor.graphs, predict_other)
    predictor.options = options


def judge_step(call: Call, name: str, step: Any) -> None:
    """Add a row for the loss and the gradients of a step on another scene.

    Args:
        call: of the section.
        name: of the row.
        step: of :mod:`benchmarks.gpu_sections`, with captured steps of this shape bucket.
    """
    batch, step.host = step.host, other_scene(step.host)
    step.data()

    def differentiate(may_replay: bool) -> list[Tensor]:
        step.optimizer.zero_grad()
        total = step.replay_loss() if may_replay else step.compute_loss()
        total.backward()
        slopes = [weight.grad for weight in step.model.parameters() if weight.grad is not None]
        return copy_to_cpu([total, *slopes])

    judge(call, name, step.captured_step.graphs, differentiate)
    step.host = batch


@torch.no_grad()
def judge_optimizer(call: Call, name: str, step: Any) -> None:
    """Add a row for the changes of a captured optimizer step, with other gradients.

    Args:
        call: of the section.
        name: of the row.
        step: of :mod:`benchmarks.gpu_sections`, whose optimizer has captured its step.
    """
    optimizer, cache = step.optimizer, getattr(step.optimizer, "graphs", None)
    if cache is None:
        return
    weights: list[nn.Parameter] = [weight for weight in step.model.parameters() if weight.requires_grad]
    written = [*weights, *(value for state in optimizer.state.values() for value in state.values())]
    before = [tensor.clone() for tensor in written]
    moved = [weight for weight in weights if weight in optimizer.state]

    def step_optimizer(may_replay: bool) -> list[Tensor]:
        for number, weight in enumerate(moved):
            weight.grad = weight.detach().roll(1).mul(0.5 + number % 3)
        optimizer.graphs = cache if may_replay else None
        optimizer.step()
        changes = [
            new - old
            for new, old in zip(copy_to_cpu(weights), copy_to_cpu(before[: len(weights)]), strict=True)
        ]
        for tensor, value in zip(written, before, strict=True):
            tensor.copy_(value)
        return changes

    judge(call, name, cache, step_optimizer)
    optimizer.graphs = cache
    optimizer.zero_grad()
