"""Launches and synchronizations of a GPU, counted on the pretend device, must not increase.

Operators of the package (:mod:`ghgs_lit.ops.dispatch`) count as one launch, as on CUDA. Counts are exact
and the same on every machine; each limit is the current count. If you reduce a count, lower its limit: a
failing test prints the line to write. Other versions of PyTorch may divide operators differently, so only
synchronizations are limited for them.
"""

import dataclasses
from typing import NamedTuple

import pytest
import torch

from benchmarks import device
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.execution import Predictor
from ghgs_lit.execution.graphs import GraphCache
from ghgs_lit.execution.step import CapturedStep
from ghgs_lit.method.model import GHGS
from ghgs_lit.rendering.api import Renderer
from ghgs_lit.training import Optimization
from ghgs_lit.training.optimization import hold_rates
from ghgs_lit.types import Batch
from tests.helpers.capture_backends import SilentBackend
from tests.helpers.losses import losses_of
from tests.helpers.models import load_model, make_model
from tests.helpers.pretend_device import DEVICE, pretend_device


class Counts(NamedTuple):
    """Counts of a prediction, and of a training step, not captured, with two rounds if the model has
    rounds."""

    launches: int
    waits: int
    step_launches: int
    step_waits: int


#: Version of PyTorch whose launches are limited.
_VERSION = "2.13."

LIMITS = {
    ("model=paper", 1): Counts(1312, 1, 2880, 2),
    ("model=paper", 8): Counts(1340, 1, 2992, 2),
    ("model=hull", 1): Counts(1525, 1, 3194, 2),
    ("model=hull", 8): Counts(1553, 1, 3307, 2),
    ("model=recurrent", 1): Counts(2023, 2, 4033, 3),
    ("model=recurrent", 8): Counts(2101, 2, 4196, 3),
    ("shipped", 1): Counts(2551, 2, 4193, 3),
    ("shipped", 8): Counts(2887, 2, 4474, 3),
}


pytestmark = pytest.mark.usefixtures("one_thread")


def two_rounds(kind: str) -> GHGS:
    """Model whose training steps have two rounds if it has rounds."""
    model = load_model() if kind == "shipped" else make_model(kind)
    if model.rounds.height is not None or kind == "model=recurrent":
        model.rounds.options = model.rounds.options.replace(training_counts=(2,))
    return model


def count_launches(kind: str, size: int) -> Counts:
    """Counts for four views of 28 x 28 pixels, or 56 x 56 with the weights that come with the package."""
    model = two_rounds(kind)
    batch = ellipsoid_batch(0.15, 4, 28, size)
    batch = Batch(batch.images, batch.masks, batch.cameras, batch.targets, depths=2.0 * batch.masks)
    with pretend_device() as log, device.render_nothing():
        model, batch = model.to(DEVICE), batch.to(DEVICE)
        for _ in range(2):  # the first fills caches, which depend only on the image size
            log.clear()
            _, launches, waits = device.forward(Predictor(model.eval()), batch, log)["total"]
        parts = device.second_step(model.train(), Optimization(lr=1e-3, matrix_scale=1.0), batch, log)
    step = [sum(numbers) for numbers in zip(*parts.values(), strict=True)]
    return Counts(launches, waits, *step[1:])


@pytest.mark.parametrize(("kind", "size"), LIMITS)
def test_a_gpu_is_asked_for_no_more_than_before(kind, size):
    """Each launch costs the host some 15 microseconds, each synchronization the time until the GPU has
    caught up."""
    found, limit = count_launches(kind, size), LIMITS[kind, size]
    counted = Counts._fields if torch.__version__.startswith(_VERSION) else ("waits", "step_waits")
    grown = [name for name in counted if getattr(found, name) > getattr(limit, name)]
    print(f'    ("{kind}", {size}): {found},')
    assert not grown


#: Launches outside the graphs of a training step, and synchronizations, by model and batch size.
AROUND = {
    ("shipped", 1): (30, 2),
    ("shipped", 8): (30, 2),
    ("model=paper", 1): (30, 2),
    ("model=paper", 8): (30, 2),
}


@pytest.mark.parametrize(("kind", "size"), AROUND)
def test_little_is_asked_for_around_a_step_that_is_played_back(kind, size):
    """Data, plan, copies, the backward pass to weights, and clipping; with the Chamfer term for the
    paper's model."""
    batch = ellipsoid_batch(0.15, 4, 28, size)
    bodies = [torch.linspace(-0.3, 0.3, 3 * 40).view(40, 3)] * size
    weights = {"chamfer": 1.0} if kind == "model=paper" else {"depth": 0.2}
    losses = losses_of({"render_l1": 0.8, **weights})
    with pretend_device() as log, device.render_nothing():
        model = two_rounds(kind).to(DEVICE).train()
        captured = CapturedStep(Predictor(model), Renderer(), losses)
        captured.graphs, captured.predictor.graphs = (GraphCache(backend=SilentBackend()) for _ in range(2))
        options = Optimization(lr=1e-3, matrix_scale=1.0)
        optimizer = options.optimizer(model)
        optimizer.graphs = GraphCache(backend=SilentBackend())
        hold_rates(optimizer)
        for _ in range(4):
            depths = 2.0 * batch.masks
            there = dataclasses.replace(batch, depths=depths, body_vertices=bodies).to(DEVICE)
            log.clear()
            captured(there).total.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), options.clip, foreach=True)
            optimizer.step()
            optimizer.zero_grad()
    found = (log.launches, log.waits.total())
    print(found)
    counted = range(2) if torch.__version__.startswith(_VERSION) else [1]
    assert all(found[number] <= AROUND[kind, size][number] for number in counted)


#: Launches outside the graphs of a prediction of the shipped weights, and synchronizations, by batch size.
PREDICTED = {1: (17, 2), 8: (45, 2)}


@pytest.mark.parametrize("size", PREDICTED)
@torch.no_grad()
def test_little_is_asked_for_around_a_prediction_that_is_played_back(size):
    """Copies of inputs and results, the plan, buffers of renderings, and slicing of results to their
    size."""
    batch = dataclasses.replace(ellipsoid_batch(0.15, 4, 28, size), targets=None)
    with pretend_device() as log, device.render_nothing():
        predictor = Predictor.from_checkpoint(map_location=DEVICE)
        predictor.graphs = GraphCache(backend=SilentBackend())
        for _ in range(3):
            there = batch.to(DEVICE)
            log.clear()
            predictor(there)
    found = (log.launches, log.waits.total())
    print(found)
    counted = range(2) if torch.__version__.startswith(_VERSION) else [1]
    assert all(found[number] <= PREDICTED[size][number] for number in counted)
