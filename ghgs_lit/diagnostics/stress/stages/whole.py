"""Stages of the whole method: tiny models, and a training step through renderer and losses."""

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import torch
from torch import Generator, Tensor, nn

from ghgs_lit.config import run_of
from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import Stage, Values, case_by_case
from ghgs_lit.diagnostics.stress.stages.geometry import batch_of, scene
from ghgs_lit.execution import Predictor
from ghgs_lit.losses import Losses
from ghgs_lit.method.model import GHGS
from ghgs_lit.rendering import render
from ghgs_lit.types import Batch, Cameras, DepthBounds, Prediction, Targets
from ghgs_lit.weights.reading import SHIPPED

_SIZE = 28
_ROUNDS = ("recurrent", SHIPPED)  #: Models that draw the number of their rounds in training
_TINY = ("encoder.width=16", "encoder.heads=2", "encoder.depth=4", "encoder.layers=[0,1,2,3]")
_TINY += ("encoder.vit.channels=8", "recalibration.k=4", "recalibration.num_heads=2")


@cache
def _models(name: str, kicked: bool) -> dict[torch.dtype, GHGS]:
    """A model in both precisions, with the weights of the package or tiny.

    A tiny one has random weights instead of the layers of 0 of its initialisation.

    Args:
        name: a file of ``conf/model``, or :data:`SHIPPED`.
        kicked: whether every weight is moved by 10.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        if name == SHIPPED:
            model = Predictor.from_checkpoint().model
        else:
            model = GHGS.from_config(run_of("train", [f"model={name}", *_TINY]).plain)
        for parameter in model.parameters():
            if kicked:  # as Adam moves every weight by the learning rate in its first step
                parameter.data += 10.0 * torch.randn_like(parameter).sign()
            elif not parameter.any():
                nn.init.normal_(parameter, std=0.1)
    model.requires_grad_()
    exact = copy.deepcopy(model).double()
    exact.bounds = partial(_in_float32, model.bounds)
    return {torch.float32: model, torch.float64: exact}


def _in_float32(bounds: Callable[[Batch], DepthBounds | None], batch: Batch) -> DepthBounds | None:
    """Bounds computed in float32, so that their decisions, tested in a stage of their own,
    agree."""
    computed = bounds(replace(batch, cameras=batch.cameras.to(torch.float32)))
    return computed if computed is None else DepthBounds(computed.near.double(), computed.far.double())


def _inputs(family: str, g: Generator) -> Values:
    values = scene(family, g, 3, _SIZE, target=True)
    values["kicked"] = torch.tensor(family == "kicked")
    return values


def _dense(prediction: Prediction, batch: Batch) -> Values:
    """Depths and Gaussians as maps; 0 where there are none, NaN for lost depths of the subject."""
    gaussians = prediction.gaussians
    size = batch.masks.shape
    parts = (gaussians.means, gaussians.scales, gaussians.opacities[:, None], gaussians.colors)
    rows = torch.cat(parts, dim=-1)
    row = gaussians.image * (size[-2] * size[-1]) + gaussians.pixel
    maps = rows.new_zeros(batch.masks.numel(), rows.shape[1]).index_copy(0, row, rows).unflatten(0, size)
    depth = torch.where(prediction.depth_valid, prediction.depth, torch.where(batch.masks, torch.nan, 0.0))
    return {"depth": depth, "means": maps[..., :3], "scales": maps[..., 3:6], "rest": maps[..., 6:]}


def _model(name: str, v: Values, training: bool) -> GHGS:
    return _models(name, bool(v["kicked"].any()))[v["images"].dtype].train(training)


def _predict(name: str, v: Values) -> Values:
    batch = batch_of(v)
    return _dense(Predictor(_model(name, v, training=name not in _ROUNDS))(batch), batch)


_LOSSES = Losses(weights={"chamfer": 0.0, "depth": 1.0})  # Chamfer has a stage of its own


@torch.enable_grad()
def _step(name: str, v: Values) -> Values:
    one = {name: value[None] for name, value in v.items()}
    model = _model(name, one, training=True)
    exact = v["images"].dtype == torch.float64
    cameras = Cameras(*inputs.matrices(one["target_lenses"], one["target_poses"]), _SIZE, _SIZE)
    masks = torch.ones(1, 1, _SIZE, _SIZE, dtype=torch.bool)
    surface = one["middle"] + 0.5 * inputs.directions(Generator().manual_seed(1), 40, 3).to(one["middle"])
    targets = Targets(one["target"], masks, cameras)
    batch = replace(batch_of(one), targets=targets, body_vertices=[surface], depths=one["truth"])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)  # of which the number of rounds is drawn
        prediction = Predictor(model)(batch)
    rendering = render(prediction.gaussians, cameras, "reference" if exact else "cpu")
    total, values = _LOSSES(prediction, rendering, batch)
    slopes = torch.autograd.grad(total, list(model.parameters()), allow_unused=True)
    gradient = torch.cat([slope.flatten() for slope in slopes if slope is not None])
    return {"losses": torch.stack(list(values.values())), "gradient": gradient}


def _far(v: Values) -> Tensor:
    """Condition number of points, sums of a camera's centre and a depth in float32: the distance
    over the subject's size, of whose depth one half is seen."""
    depth = v["truth"].flatten(1)
    nearest = torch.where(depth > 0, depth, torch.inf).amin(1)
    return depth.amax(1) / (2 * (depth.amax(1) - nearest))


_NETWORK = "thirty layers in a row, each as accurate as a dense head alone; their errors add up"
_FRAME = ("truth", "middle", "target", "target_lenses", "target_poses")
#: What all stages here share.
_stage = partial(
    Stage,
    ingredients=("cameras", "images", "masks", "weights"),
    make=_inputs,
    factor=100,
    seeds=20,
    kind="network",
    kappa=_far,
    excluded={
        "wide": "the subject is smaller than a pixel",
        "degenerate": "no photographs come from such a camera",
    },
    refused=("out_of_range",),
)

STAGES = (
    *(
        _stage(
            f"pipeline {name}",
            run=partial(_predict, name),
            reason=_NETWORK,
            steady=_FRAME,
            silent="what the model does not read is not in its output",
        )
        for name in ("paper", "hull", "recurrent", SHIPPED)
    ),
    *(
        _stage(
            f"training step {name}",
            run=case_by_case(partial(_step, name)),
            reason=f"{_NETWORK}, forward and backward, and the losses'",
            steady=("middle",),
            silent="what the step does not read is not in its loss",
        )
        for name in ("hull", "recurrent")
    ),
)
