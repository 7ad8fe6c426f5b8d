"""Stages of rendering, losses and metrics: splats, compositing, L1, SSIM, Chamfer, PSNR, FLIP."""

import torch
from torch import Generator, Tensor

from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import Stage, Values, case_by_case
from ghgs_lit.geometry.chamfer import chamfer
from ghgs_lit.geometry.precision import exact
from ghgs_lit.metrics.flip import flip_map
from ghgs_lit.metrics.functional import psnr, ssim
from ghgs_lit.rendering import RasterSettings, reference, render
from ghgs_lit.types import Cameras, Gaussians

_SIZE = 16
_FIELDS = ("means", "quaternions", "scales", "opacities", "colors")


def _inputs(family: str, g: Generator) -> Values:
    count = 1500 if family == "stacked" else 24
    middle = inputs.place(family, g)
    lenses, poses = inputs.cameras(family, g, 1, _SIZE, middle)
    means = inputs.points(family, g, count, middle, poses)
    if family == "stacked":
        axis = poses[0, 2, :3]
        means = middle + axis * inputs.uniform(g, -0.5, 0.5, count, 1) + 0.01 * inputs.normal(g, count, 3)
    return {
        "means": means,
        "quaternions": inputs.quaternions(family, g, count),
        "scales": inputs.scales(family, g, count, 0.3),
        "opacities": inputs.opacities(family, g, count) * (0.02 if family == "stacked" else 1.0),
        "colors": inputs.uniform(g, 0, 1, count, 3),
        "lenses": lenses,
        "poses": poses,
    }


def _gaussians(v: Values) -> Gaussians:
    n, count = v["opacities"].shape
    return Gaussians(*(v[name].flatten(0, 1) for name in _FIELDS), splits=(count,) * n)


def _cameras(v: Values) -> Cameras:
    return Cameras(*inputs.matrices(v["lenses"], v["poses"]), _SIZE, _SIZE)


def _project(v: Values) -> Values:
    with exact("cpu"):  # as in render()
        splats = reference.project(
            Gaussians(*(v[name] for name in _FIELDS), splits=(len(v["means"]),)),
            _cameras(v)[0],
            RasterSettings(antialiased=True),
        )
    xx, xy, yy = splats.covariances.unbind(-1)
    values = {
        "centers": splats.centers,
        "inverses": torch.stack((yy, -xy, xx), -1) / splats.determinants[:, None],
        # Fainter splats are not drawn.
        "opacities": torch.relu(splats.opacities[:, None] - 1 / 255),
        "covariances": splats.covariances,
    }
    front = (splats.depths > 0)[:, None]
    return {name: torch.where(front, value, 0.0) for name, value in values.items()}


def _render(backend: str, v: Values) -> Values:
    rendering = render(_gaussians(v), _cameras(v), backend, near=1e-6)
    return {"image": rendering.image, "alpha": rendering.alpha}


def _pair(family: str, g: Generator) -> Values:
    image = inputs.images(family, g, 3, _SIZE, _SIZE)
    target = image if family == "identical" else inputs.images(family, g, 3, _SIZE, _SIZE)
    return {"image": image.clone(), "target": target.clone()}


def _l1(v: Values) -> Tensor:
    return (v["image"] - v["target"]).abs().flatten(1).mean(1)


def _ssim_slowly(v: Values) -> Values:
    """L1, and SSIM by moments about the mean of each window."""
    x = torch.arange(11, dtype=v["image"].dtype) - 5
    line = torch.exp(-x.square() / (2 * 1.5**2))
    weights = (line[:, None] * line / line.sum() ** 2).flatten()
    a, b = (image.unfold(2, 11, 1).unfold(3, 11, 1).flatten(4) for image in (v["image"], v["target"]))
    mean_a, mean_b = ((p * weights).sum(-1) for p in (a, b))
    da = a - mean_a[..., None]
    db = b - mean_b[..., None]
    aa, bb, ab = ((p * q * weights).sum(-1) for p, q in ((da, da), (db, db), (da, db)))
    c1 = 0.01**2
    c2 = 0.03**2
    first = (2 * mean_a * mean_b + c1) / (mean_a.square() + mean_b.square() + c1)
    values = first * (2 * ab + c2) / (aa + bb + c2)
    return {"l1": _l1(v), "ssim": values.flatten(1).mean(1)}


def _brightest(v: Values) -> Tensor:
    return torch.cat((v["image"], v["target"]), 1).flatten(1).abs().amax(1)


def _moments(v: Values) -> Tensor:
    """Condition number of SSIM, which subtracts moments of size x^2 and compares the rest
    with 0.03^2."""
    return _brightest(v).square() / 9e-4


def _terms(v: Values) -> Tensor:
    """Size of the terms that SSIM's gradients subtract: 2 x / 0.03^2,
    each a mean over the windows."""
    windows = 3 * (_SIZE - 10) ** 2
    return 2 * _brightest(v) / (9e-4 * windows)


def _metrics(v: Values) -> Values:
    flip = flip_map(v["image"], v["target"]).flatten(1).mean(1)
    return {"psnr": psnr(v["image"], v["target"]), "flip": flip}


def _clouds(family: str, g: Generator) -> Values:
    middle = inputs.place(family, g)
    count = {"few": 3, "single": 1}.get(family, 20)
    return {
        "points": inputs.points(family, g, count, middle),
        "surface": middle + 0.3 * inputs.UNITS.get(family, 1.0) * inputs.normal(g, count, 3),
    }


def _ties(v: Values) -> Tensor:
    """The largest number where several points are at one place,
    so that any of them may be the nearest."""
    apart = (v["points"][:, :, None] - v["points"][:, None]).abs().sum(-1)
    tied = (apart == 0).flatten(1).sum(1) > apart.shape[1]
    return tied * torch.tensor(torch.finfo(torch.float64).max, dtype=torch.float64)


def _chamfer_slowly(v: Values) -> Values:
    apart = (v["points"][:, None] - v["surface"]).square().sum(-1)
    return {"chamfer": 2 * torch.cat((apart.amin(1), apart.amin(0))).mean()}


_TAKES = ("cameras", "points", "quaternions", "scales", "opacities")
_NOT_DRAWN = "a splat that is not finite is not drawn; the report of ghgs predict counts it"

STAGES = (
    Stage(
        "splat projection", _TAKES, _inputs, case_by_case(_project), 100,
        "a product of four matrices, squared, and a quotient of two determinants",
        gradients=("means", "quaternions", "scales"), seeds=32, silent=_NOT_DRAWN,
        excluded={"on_camera": "nearer than near: left out before", "behind": "left out before"},
    ),
    Stage(
        "compositing", _TAKES, _inputs, lambda v: _render("cpu", v), 100,
        "an exponential of a square, and a product of up to 1500 transmittances",
        lambda v: _render("reference", v), gradients=_FIELDS, seeds=24, silent=_NOT_DRAWN,
        kind="kernel",
    ),
    Stage(
        "L1 and SSIM", ("images",), _pair,
        lambda v: {"l1": _l1(v), "ssim": ssim(v["image"], v["target"])}, 20,
        "five blurs of 121 products; the subtraction of moments is in kappa", _ssim_slowly,
        gradients=("image",), kappa=_moments, sizes=_terms, seeds=96,
    ),
    Stage(
        "Chamfer", ("cameras", "points", "neighbors"), _clouds,
        case_by_case(lambda v: {"chamfer": chamfer(v["points"], v["surface"])}), 20,
        "means of squares of differences", case_by_case(_chamfer_slowly), gradients=("points", "surface"),
        seeds=96, sizes=_ties,
        excluded=inputs.NO_CAMERA,
    ),
    Stage(
        "PSNR and FLIP", ("images",), _pair, _metrics, 100,
        "powers 0.42 and 2.4 of colours, seven filters, a power 0.7 of a distance",
        # FLIP raises a rounding error of a colour to a power of about 0.1;
        # one pixel of 256 may have one.
        kappa=lambda v: torch.full((len(v["image"]),), 8.0, dtype=torch.float64),
        silent="FLIP clamps colours to [0, 1]",
    ),
)  # fmt: skip
