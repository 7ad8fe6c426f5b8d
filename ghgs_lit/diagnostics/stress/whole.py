"""Stages of the whole method: gains, refinement, predictions of tiny and shipped models, and training steps
through renderer and losses."""

import copy
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial

import torch
from torch import Generator, Tensor, nn

from ghgs_lit.config import run_of
from ghgs_lit.diagnostics.stress import stages
from ghgs_lit.diagnostics.stress.families import (
    FAMILIES,
    Values,
    batch_of,
    cameras_of,
    directions,
    sphere,
    uniform,
    vary,
)
from ghgs_lit.diagnostics.stress.measure import Stage, case_by_case
from ghgs_lit.evaluation.baselines import splats_at
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.losses import Losses
from ghgs_lit.method.model import GHGS
from ghgs_lit.method.rounds.gains import log_gains
from ghgs_lit.refinement.refinement import Refinement
from ghgs_lit.rendering import Renderer, render
from ghgs_lit.types import Batch, DepthBounds, Gaussians, Prediction, Targets
from ghgs_lit.weights.reading import SHIPPED

_SIZE = 28
_ROUNDS = ("recurrent", SHIPPED)  #: Models with a random number of rounds in training
_TINY = ("encoder.width=16", "encoder.heads=2", "encoder.depth=4", "encoder.layers=[0,1,2,3]")
_TINY += ("encoder.vit.channels=8", "recalibration.k=4", "recalibration.num_heads=2")


def _surface(views: int, size: int, family: str, g: Generator) -> Values:
    """A sphere with the same colours in all views (unless the family is one of images), ``gains`` [v, 3] of
    the views, and ``opacities`` [v, s, s] of splats on it."""
    values = sphere(family, g, views, size)
    if FAMILIES[family].ingredient != "images":
        one = {name: value[None] for name, value in values.items()}
        around = unproject_maps(values["truth"], cameras_of(one, size)[0]) - values["middle"]
        colors = (0.5 + 0.4 * torch.sin(9 * around)) * (values["truth"] > 0)[..., None]
        values["images"] = colors.movedim(-1, 1).contiguous()
    opacities = vary("opacities", family, uniform(g, 0.05, 0.98, views, size, size), g)
    return {**values, "gains": uniform(g, 0.7, 1.0, views, 3), "opacities": opacities}


def _make_surface_splats(v: Values) -> tuple[Gaussians, Batch]:
    """Splats of a pixel's size on the true surface of one case, and its input views times the gains."""
    one = {name: value[None] for name, value in v.items()}
    one["images"] = one["images"] * one["gains"][..., None, None]
    batch = batch_of(one)
    subject = batch.masks & (one["truth"] > 0)
    splats = splats_at(batch, one["truth"], subject, sigma=0.5)
    return replace(splats, opacities=one["opacities"][subject]), batch


def _gains(v: Values) -> Values:
    return {"logs": log_gains(*_make_surface_splats(v))[0]}


def _refine(v: Values) -> Values:
    """Renders after two steps; not Gaussians, since those that no view shows move by the sign of rounding."""
    backend = stages.backend_of(v["images"])
    gaussians, batch = _make_surface_splats(v)
    refined = Refinement(2, Renderer(backend=backend))(gaussians, batch)
    rendering = render(refined, batch.cameras, backend)
    return {"image": rendering.image[0], "alpha": rendering.alpha[0]}


@cache
def _models(name: str, kicked: bool) -> dict[torch.dtype, GHGS]:
    """A model in float32 and float64: the shipped one, or a tiny one with random weights also in layers that
    are initialised with 0.

    Args:
        name: a file of ``conf/model``, or :data:`SHIPPED`.
        kicked: whether 10 is added to or subtracted from every weight.
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
    """Bounds computed in float32, so that their decisions, which another stage tests, are equal."""
    computed = bounds(replace(batch, cameras=batch.cameras.to(torch.float32)))
    return computed if computed is None else DepthBounds(computed.near.double(), computed.far.double())


def _scene(family: str, g: Generator) -> Values:
    return sphere(family, g, 3, _SIZE, target=True) | {"kicked": torch.tensor(family == "kicked")}


def _dense(prediction: Prediction, batch: Batch) -> Values:
    """Depths and Gaussians as maps: 0 where there are none, NaN where a depth of the subject is not valid."""
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
    cameras = cameras_of(one, _SIZE, "target_")
    masks = torch.ones(1, 1, _SIZE, _SIZE, dtype=torch.bool)
    surface = one["middle"] + 0.5 * directions(Generator().manual_seed(1), 40, 3).to(one["middle"])
    targets = Targets(one["target"], masks, cameras)
    batch = replace(batch_of(one), targets=targets, body_vertices=[surface], depths=one["truth"])
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)  # for the number of rounds
        prediction = Predictor(model)(batch)
    rendering = render(prediction.gaussians, cameras, stages.backend_of(one["images"]))
    total, values = _LOSSES(prediction, rendering, batch)
    slopes = torch.autograd.grad(total, list(model.parameters()), allow_unused=True)
    gradient = torch.cat([slope.flatten() for slope in slopes if slope is not None])
    return {"losses": torch.stack(list(values.values())), "gradient": gradient}


def _far(v: Values) -> Tensor:
    """Condition number of points, which are sums of a camera's centre and a depth: the distance over the
    subject's size, of which the views show one half in depth."""
    depth = v["truth"].flatten(1)
    nearest = torch.where(depth > 0, depth, torch.inf).amin(1)
    return depth.amax(1) / (2 * (depth.amax(1) - nearest))


#: Shared by all stages of input views. In ``wide`` the subject is smaller than a pixel.
_stage = partial(
    Stage,
    ingredients=("place", "cameras", "images", "masks", "weights", "opacities"),
    factor=100,
    seeds=20,
    without=("wide", "degenerate"),
    silent="what is not read, drawn or seen by another view has no effect",
)
# These stages need a subject in metres.
_surface_stage = partial(
    _stage,
    steady=("middle", "truth"),
    without=("wide", "degenerate", "large", "small", "kicked"),
)
_network = partial(
    _stage,
    ingredients=("place", "cameras", "images", "masks", "weights"),
    make=_scene,
    reason="thirty layers in a row, each as accurate as a dense head alone; their errors add up",
    is_network=True,
    kappa=_far,
)
_FRAME = ("truth", "middle", "target", "target_lenses", "target_poses")

WHOLE = (
    _surface_stage(
        "gains",
        make=partial(_surface, 5, 32),
        run=case_by_case(_gains),
        reason="logarithms of samples at projected places, weighted by depths of a render, five times",
    ),
    _surface_stage(
        "refinement",
        make=partial(_surface, 2, 14),
        run=case_by_case(_refine),
        reason="three renders, gradients of two, and steps that divide them by their size",
    ),
    *(
        _network(f"pipeline {name}", run=partial(_predict, name), steady=_FRAME)
        for name in ("paper", "hull", "recurrent", SHIPPED)
    ),
    *(
        _network(f"training step {name}", run=case_by_case(partial(_step, name)), steady=("middle",))
        for name in ("hull", "recurrent")
    ),
)

#: All stages by their names.
STAGES = {stage.name: stage for stage in (*stages.STAGES, *WHOLE)}
