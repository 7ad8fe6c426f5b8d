"""The whole method: a tiny model, and a training step through renderer and losses."""

import copy
import dataclasses
from collections.abc import Callable
from functools import cache, partial

import torch
from torch import Generator, Tensor, nn

from ghgs_lit.config import compose, resolve
from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import Stage, Values
from ghgs_lit.diagnostics.stress.stages.geometry import batch_of, scene
from ghgs_lit.losses import Losses
from ghgs_lit.model import GHGS
from ghgs_lit.rendering import render
from ghgs_lit.types import Batch, Cameras, DepthBounds, Gaussians, Prediction, Targets

_SIZE = 28
_TINY = ("encoder.width=16", "encoder.heads=2", "encoder.depth=4", "encoder.layers=[0,1,2,3]")
_TINY += ("encoder.vit.channels=8", "recalibration.k=4", "recalibration.num_heads=2")


@cache
def _models(name: str, kicked: bool) -> dict[torch.dtype, GHGS]:
    """A tiny model that has left its initial state, in both precisions."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        model = GHGS.from_config(resolve(compose("train", [f"model={name}", *_TINY])))
        for parameter in model.parameters():
            if kicked:  # as Adam moves every weight by the learning rate in its first step
                parameter.data += 10.0 * torch.randn_like(parameter).sign()
            elif not parameter.any():
                nn.init.normal_(parameter, std=0.1)
    model.options = model.options.replace(check_inputs=True)
    # Rounds draw their number in training.
    model.train(name != "recurrent")
    exact = copy.deepcopy(model).double()
    exact.bounds = partial(_in_float32, model.bounds)
    return {torch.float32: model, torch.float64: exact}


def _in_float32(bounds: Callable[[Batch], DepthBounds | None], batch: Batch) -> DepthBounds | None:
    """Bounds as in single precision: decisions on a grid, which "bounds and hull" measures, are the same."""
    found = bounds(dataclasses.replace(batch, cameras=batch.cameras.to(torch.float32)))
    return found if found is None else DepthBounds(found.near.double(), found.far.double())


def _inputs(family: str, g: Generator) -> Values:
    found = scene(family, g, 3, _SIZE, target=True)
    found["kicked"] = torch.tensor(family == "kicked")
    return found


def _dense(prediction: Prediction, batch: Batch) -> Values:
    """Depths and Gaussians as maps, 0 where there are none; a depth of the subject that was lost is NaN."""
    gaussians: Gaussians = prediction.gaussians
    b, v, h, w = batch.masks.shape
    rows = torch.cat(
        (gaussians.means, gaussians.scales, gaussians.opacities[:, None], gaussians.colors), dim=-1
    )
    place = gaussians.image * (h * w) + gaussians.pixel
    maps = rows.new_zeros(b * v * h * w, rows.shape[1]).index_copy(0, place, rows).reshape(b, v, h, w, -1)
    depth = torch.where(prediction.depth_valid, prediction.depth, torch.where(batch.masks, torch.nan, 0.0))
    return {"depth": depth, "means": maps[..., :3], "scales": maps[..., 3:6], "rest": maps[..., 6:]}


def _model(name: str, v: Values) -> GHGS:
    return _models(name, bool(v["kicked"].any()))[v["images"].dtype]


def _predict(name: str, v: Values) -> Values:
    batch = batch_of(v)
    return _dense(_model(name, v)(batch), batch)


_LOSSES = Losses({"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 1.0, "depth": 1.0}, chamfer="huber")


def _step(v: Values) -> Values:
    """The loss of each case, and the gradient of every parameter."""
    losses, slopes = [], []
    model = _model("hull", v)
    for i in range(len(v["images"])):
        one = {name: value[i : i + 1] for name, value in v.items()}
        cameras = Cameras(*inputs.matrices(one["target_lenses"], one["target_poses"]), _SIZE, _SIZE)
        masks = torch.ones(1, 1, _SIZE, _SIZE, dtype=torch.bool)
        batch = batch_of(one)
        surface = one["middle"] + 0.5 * inputs.directions(Generator().manual_seed(1), 40, 3).to(one["middle"])
        batch = Batch(
            batch.images, batch.masks, batch.cameras, Targets(one["target"], masks, cameras), [surface],
            one["truth"],
        )  # fmt: skip
        with torch.enable_grad():
            prediction = model(batch)
            backend = "reference" if v["images"].dtype == torch.float64 else "cpu"
            rendering = render(prediction.gaussians, cameras, backend)
            total, values = _LOSSES(prediction, rendering, batch)
            found = torch.autograd.grad(total, list(model.parameters()), allow_unused=True)
        losses.append(torch.stack(list(values.values())))
        slopes.append(torch.cat([s.flatten() for s in found if s is not None]))
    return {"losses": torch.stack(losses), "gradient": torch.stack(slopes)}


def _far(v: Values) -> Tensor:
    """A point is its camera's centre and a depth, both in float32: it loses the digits of the distance over
    the subject's size, of whose depth one half is seen."""
    depth = v["truth"].flatten(1)
    nearest = torch.where(depth > 0, depth, torch.inf).amin(1)
    return depth.amax(1) / (2 * (depth.amax(1) - nearest))


_NETWORK = "thirty layers in a row, each as accurate as a dense head alone; their errors add up"
_SMALL = {
    "wide": "the subject is smaller than a pixel",
    "degenerate": "no photographs come from such a camera",
}


def _pipeline(name: str) -> Stage:
    return Stage(
        f"pipeline {name}", ("cameras", "images", "masks", "weights"), _inputs,
        lambda v: _predict(name, v), 100, _NETWORK,
        steady=("truth", "middle", "target", "target_lenses", "target_poses"), seeds=20, quick=1,
        network=True, kappa=_far, excluded=_SMALL, refused=("out_of_range",),
        silent="what the model does not read is not in its output",
    )  # fmt: skip


STAGES = (
    _pipeline("paper"),
    _pipeline("hull"),
    _pipeline("recurrent"),
    Stage(
        "training step", ("cameras", "images", "masks", "weights"), _inputs, _step, 100,
        f"{_NETWORK}, forward and backward, and the losses'", seeds=20, quick=1, network=True, kappa=_far,
        excluded=_SMALL,
        steady=("middle",), refused=("out_of_range",),
        silent="what the step does not read is not in its loss",
    ),
)  # fmt: skip
