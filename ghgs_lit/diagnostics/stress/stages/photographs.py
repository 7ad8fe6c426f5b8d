"""Stages around photographs: undistortion, gains of cameras, refinement."""

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Generator, Tensor

from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import FAMILIES, Stage, Values, case_by_case
from ghgs_lit.diagnostics.stress.stages.geometry import batch_of, cameras_of, scene
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.geometry.undistortion import undistorting_grid
from ghgs_lit.method.rounds.gains import log_gains
from ghgs_lit.metrics.functional import ssim
from ghgs_lit.refinement.refinement import Refinement
from ghgs_lit.rendering import Renderer, render
from ghgs_lit.types import Batch, Gaussians

_LENS = 17  #: Side of a photograph with a lens, in pixels
_STEP = 8  #: Pixels between evaluations of the lens's model


def _lens_inputs(family: str, g: Generator) -> Values:
    """A lens and its distortion, with ``within`` [2, s, s]: 1 within the radius at which OpenCV's
    and the fisheye's model turn back, -1 beyond it, 0 near it, where rounding decides."""
    lenses, _ = inputs.cameras(family, g, 1, _LENS, inputs.place(family, g))
    radial = inputs.uniform(g, -0.1, 0.1, 4)
    fx, fy, cx, cy = lenses[0]
    pixels = torch.arange(_LENS, dtype=torch.float64) + 0.5
    radii = torch.hypot((pixels - cx) / fx, ((pixels - cy) / fy)[:, None])
    turns = _turn(radial[:3]), np.tan(min(_turn(radial), np.pi / 2))
    ratios = torch.stack([radii / turn for turn in turns])
    return {
        "lens": lenses[0],
        "radial": radial,
        "p": inputs.uniform(g, -0.02, 0.02, 2),
        "within": (ratios < 0.99).double() - (ratios > 1.01).double(),
    }


def _turn(radial: Tensor) -> float:
    """The least x > 0 at which x (1 + k1 x^2 + k2 x^4 + ...) stops growing; infinity: none."""
    slopes = [1.0, *((2 * i + 3) * float(k) for i, k in enumerate(radial))]
    squares = np.roots(slopes[::-1])
    return float(np.sqrt(squares.real[(squares.imag == 0) & (squares.real > 0)].min(initial=np.inf)))


def _lens(v: Values) -> Values:
    """Where the pixels of the undistorted image lie in the photograph,
    for OpenCV's and a fisheye's model."""
    matrices = inputs.intrinsics(v["lens"]).numpy()
    k1, k2, k3, _ = v["radial"].mT
    opencv = torch.stack((k1, k2, *v["p"].mT, k3), -1).numpy()
    models = {"opencv": (opencv, False), "fisheye": (v["radial"].numpy(), True)}
    grids = {}
    for (name, (lens, fisheye)), within in zip(models.items(), v["within"].unbind(1), strict=True):
        pairs = zip(matrices, lens, strict=True)
        grid = torch.cat([undistorting_grid(k, d, _LENS, _LENS, fisheye) for k, d in pairs])
        grids[name] = grid * within.abs()[..., None]
    return grids


def _lens_slowly(v: Values) -> Values:
    knots = torch.linspace(0.5, _LENS - 0.5, -(-_LENS // _STEP) + 1, dtype=torch.float64)
    fx, fy, cx, cy = (value[:, None, None] for value in v["lens"].mT)
    x, y = torch.broadcast_tensors((knots - cx) / fx, (knots[:, None] - cy) / fy)
    k1, k2, k3, k4 = (value[:, None, None] for value in v["radial"].mT)
    p1, p2 = (value[:, None, None] for value in v["p"].mT)
    r = x * x + y * y
    radial = 1 + k1 * r + k2 * r**2 + k3 * r**3
    opencv = (
        x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x),
        y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y,
    )
    angle = r.sqrt().atan()
    bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
    share = torch.where(r > 0, bent / r.sqrt(), 1.0)
    places = {"opencv": opencv, "fisheye": (share * x, share * y)}
    return {
        name: _between_knots(torch.stack((fx * across + cx, fy * down + cy), 1), within)
        for (name, (across, down)), within in zip(places.items(), v["within"].unbind(1), strict=True)
    }


def _between_knots(pixels: Tensor, within: Tensor) -> Tensor:
    grid = 2 * pixels / _LENS - 1
    dense = torch.nn.functional.interpolate(grid, (_LENS, _LENS), mode="bilinear", align_corners=True)
    beyond = 4.0  # outside of the photograph
    return torch.where(within[:, None] < 0, beyond, dense * within[:, None]).permute(0, 2, 3, 1)


def _surface_inputs(views: int, size: int, family: str, g: Generator) -> Values:
    """A sphere with the same colours in all views, up to their gains,
    where the family is none of images.

    Args:
        views: number v of input views.
        size: side s of the images in pixels.
        family: of the case.
        g: source of the numbers.

    Returns:
        As :func:`scene`, with ``gains`` [v, 3] and ``opacities`` [v, s, s].
    """
    values = scene(family, g, views, size)
    if FAMILIES[family].ingredient != "images":
        cameras = cameras_of({name: value[None] for name, value in values.items()}, size)
        around = unproject_maps(values["truth"][None], cameras)[0] - values["middle"]
        values["images"] = (0.5 + 0.4 * torch.sin(9 * around)).movedim(-1, 1) * (values["truth"] > 0)[:, None]
        values["images"] = values["images"].contiguous()
    opacities = inputs.opacities(family, g, views * size * size).view(views, size, size)
    return {**values, "gains": inputs.uniform(g, 0.7, 1.0, views, 3), "opacities": opacities}


def _seen(v: Values) -> tuple[Gaussians, Batch]:
    """Splats of a pixel's size on the true surface of one case, and its photographs,
    darker by gains."""
    one = {name: value[None] for name, value in v.items()}
    one["images"] = one["images"] * one["gains"][..., None, None]
    batch = batch_of(one)
    subject = batch.masks & (one["truth"] > 0)
    image, pixel = subject.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
    means = unproject_maps(one["truth"], batch.cameras)[subject]
    size = (one["truth"] / batch.cameras.intrinsics[..., 0, 0, None, None])[subject]
    quaternions = means.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(len(means), 4)
    opacities = one["opacities"][subject]
    colors = batch.images.movedim(2, -1)[subject]
    scales = 0.5 * size[:, None].expand(-1, 3)
    return Gaussians(means, quaternions, scales, opacities, colors, (len(means),), image, pixel), batch


def _gains(v: Values) -> Values:
    return {"logs": log_gains(*_seen(v))[0]}


_STEPS = 2


def _refined(v: Values) -> Values:
    """Renders after some steps: what no photograph shows moves by the sign of rounding."""
    gaussians, batch = _seen(v)
    backend = "reference" if v["images"].dtype == torch.float64 else "cpu"
    return _renders(Refinement(_STEPS, Renderer(backend=backend))(gaussians, batch), batch, backend)


def _renders(gaussians: Gaussians, batch: Batch, backend: str) -> Values:
    drawn = render(gaussians, batch.cameras, backend)
    return {"image": drawn.image[0], "alpha": drawn.alpha[0]}


def _refined_slowly(v: Values) -> Values:
    """The same with Adam (Kingma and Ba, 2015, Algorithm 1), all changes and the detail at the
    end written out."""
    start, batch = _seen(v)
    views = start.image
    photographs = batch.images * batch.masks[:, :, None]
    focal = batch.cameras.intrinsics[0, :, [0, 1], [0, 1]].prod(-1).sqrt()[views]
    axes = batch.cameras.extrinsics[0, :, 2, :3]
    shifts = batch.cameras.extrinsics[0, :, 2, 3]
    side = (((axes[views] * start.means).sum(-1) + shifts[views]) / focal)[:, None]
    odds = (start.opacities.clamp(1e-4, 1 - 1e-4) / (1 - start.opacities.clamp(1e-4, 1 - 1e-4))).log()
    fields = (start.means, start.scales, odds, start.colors)
    raw = [torch.zeros_like(field) for field in fields]
    means = [torch.zeros_like(field) for field in fields]
    squares = [torch.zeros_like(field) for field in fields]

    def changed(raw: list[Tensor]) -> Gaussians:
        move, grow, more, tint = (c * (x / c).tanh() for c, x in zip((1, 1, 2, 0.05), raw, strict=True))
        opacities = 1 / (1 + (-odds - more).exp())
        parts = {"scales": start.scales * grow.exp(), "opacities": opacities, "colors": start.colors + tint}
        return replace(start, means=start.means + side * move, **parts)

    for number in range(1, _STEPS + 1):
        leaves = [x.detach().requires_grad_() for x in raw]
        with torch.enable_grad():
            drawn = render(changed(leaves), batch.cameras, "reference")
            error = (drawn.image - photographs).abs().mean()
            outline = (drawn.alpha[:, :, 0] - batch.masks.double()).abs().mean()
            alike = ssim(drawn.image.flatten(0, 1), photographs.flatten(0, 1), padding="valid").mean()
            slopes = torch.autograd.grad(0.8 * error + 0.2 * (1 - alike) + 0.1 * outline, leaves)
        means = [0.9 * m + 0.1 * slope for m, slope in zip(means, slopes, strict=True)]
        squares = [0.95 * s + 0.05 * slope**2 for s, slope in zip(squares, slopes, strict=True)]
        for x, m, s, rate in zip(raw, means, squares, (0.04, 0.03, 0.04, 0.001), strict=True):
            x -= rate * m / (1 - 0.9**number) / ((s / (1 - 0.95**number)).sqrt() + 1e-15)
    refined = changed(raw)
    missing = photographs - render(refined, batch.cameras, "reference").image
    sums = sum(_shifted(missing, 1, 0.0))
    fine = missing - sums / sum(_shifted(torch.ones_like(missing), 1, 0.0))
    inside = torch.stack(_shifted(batch.masks.double(), 2, 1.0)).amin(0)
    detail = (fine * inside[:, :, None]).movedim(2, -1)[0].flatten(1, 2)[views, start.pixel]
    refined = replace(refined, colors=refined.colors + (2 * detail).clamp(-0.1, 0.1))
    return _renders(refined, batch, "reference")


def _shifted(maps: Tensor, pixels: int, beyond: float) -> list[Tensor]:
    """The maps, moved up to some pixels along both axes, with a value beyond the border."""
    height, width = maps.shape[-2:]
    padded = torch.nn.functional.pad(maps, [pixels] * 4, value=beyond)
    steps = range(2 * pixels + 1)
    return [padded[..., i : i + height, j : j + width] for i in steps for j in steps]


_EXCLUDED = {
    "wide": "the subject is smaller than a pixel",
    "degenerate": "nothing is in the frame",
    "large small": "these stages see the subject in metres",
    "stacked": "one splat a pixel",
}

STAGES = (
    Stage(
        "undistortion", ("cameras",), _lens_inputs, _lens, 50,
        "a polynomial of degree 9 and its division by the focal length", _lens_slowly,
        steady=("within",), kind="kernel",
    ),
    Stage(
        "gains", ("cameras", "images", "masks"), partial(_surface_inputs, 5, 32), case_by_case(_gains), 100,
        "logarithms of samples at projected places, weighted by depths of a render, five times",
        steady=("middle", "truth"), seeds=24, excluded=_EXCLUDED,
        silent="what no other view sees says nothing",
    ),
    Stage(
        "refinement", ("cameras", "images", "masks", "opacities"), partial(_surface_inputs, 2, 14),
        case_by_case(_refined), 100,
        "three renders, gradients of two, and steps that divide them by their size",
        case_by_case(_refined_slowly),
        steady=("middle", "truth"), seeds=24, excluded=_EXCLUDED,
        silent="what is not drawn does not show",
    ),
)  # fmt: skip
