"""Losses and metrics: L1, SSIM, Chamfer, PSNR, FLIP."""

import torch
from torch import Generator, Tensor

from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import Stage, Values, case_by_case, except_for
from ghgs_lit.geometry.chamfer import chamfer
from ghgs_lit.metrics.flip import flip_map
from ghgs_lit.metrics.functional import psnr, ssim

_SIZE = 16


def _pair(family: str, g: Generator) -> Values:
    image = inputs.images(family, g, 3, _SIZE, _SIZE)
    target = image if family == "identical" else inputs.images(family, g, 3, _SIZE, _SIZE)
    return {"image": image.clone(), "target": target.clone()}


def _l1(v: Values) -> Tensor:
    return (v["image"] - v["target"]).abs().flatten(1).mean(1)


def _ssim_slowly(v: Values) -> Values:
    """Moments about the mean of each window."""
    x = torch.arange(11, dtype=v["image"].dtype) - 5
    line = torch.exp(-x.square() / (2 * 1.5**2))
    weights = (line[:, None] * line / line.sum() ** 2).flatten()
    a, b = (image.unfold(2, 11, 1).unfold(3, 11, 1).flatten(4) for image in (v["image"], v["target"]))
    mean_a, mean_b = ((p * weights).sum(-1) for p in (a, b))
    da, db = a - mean_a[..., None], b - mean_b[..., None]
    aa, bb, ab = ((p * q * weights).sum(-1) for p, q in ((da, da), (db, db), (da, db)))
    c1, c2 = 0.01**2, 0.03**2
    first = (2 * mean_a * mean_b + c1) / (mean_a.square() + mean_b.square() + c1)
    values = first * (2 * ab + c2) / (aa + bb + c2)
    return {"l1": _l1(v), "ssim": values.flatten(1).mean(1)}


def _brightest(v: Values) -> Tensor:
    return torch.cat((v["image"], v["target"]), 1).flatten(1).abs().amax(1)


def _moments(v: Values) -> Tensor:
    """SSIM's definition subtracts moments of the size x^2 and compares the rest with 0.03^2."""
    return _brightest(v).square() / 9e-4


def _terms(v: Values) -> Tensor:
    """Gradients of SSIM subtract terms of the size 2 x / 0.03^2, each a mean over the windows."""
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


def _chamfer_slowly(v: Values) -> Values:
    """All distances, in the precision of the inputs."""
    apart = (v["points"][:, None] - v["surface"]).square().sum(-1)
    return {"chamfer": 2 * torch.cat((apart.amin(1), apart.amin(0))).mean()}


STAGES = (
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
        seeds=96, ties=("duplicates", "collapsed"),
        excluded=except_for({**inputs.NO_CAMERA, "masked": "takes no masks"}),
    ),
    Stage(
        "PSNR and FLIP", ("images",), _pair, _metrics, 100,
        "powers 0.42 and 2.4 of colours, seven filters, a power 0.7 of a distance",
        # Colours that differ by a rounding have a distance of its power 0.1 or so: one pixel of 256 may.
        kappa=lambda v: torch.full((len(v["image"]),), 8.0, dtype=torch.float64),
        silent="FLIP clamps colours to [0, 1]",
    ),
)  # fmt: skip
