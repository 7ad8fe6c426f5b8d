"""Splats on the image: projection and inversion of covariances, compositing."""

import torch
from torch import Generator

from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import FLOAT32_ONLY, Stage, Values, case_by_case
from ghgs_lit.kernels.precision import exact
from ghgs_lit.rendering import RasterSettings, reference, render
from ghgs_lit.types import Cameras, Gaussians

_SIZE = 16
_FIELDS = ("means", "quaternions", "scales", "opacities", "colors")


def _inputs(family: str, g: Generator, count: int = 24) -> Values:
    """Splats of some pixels around the middle of a scene, before one camera."""
    count = 1500 if family == "stacked" else count
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
    """Centres, covariances, their inverses and determinants of the splats before the camera."""
    with exact("cpu"):  # as in render()
        splats = reference.project(
            Gaussians(*(v[name] for name in _FIELDS), splits=(len(v["means"]),)),
            _cameras(v)[0],
            RasterSettings(antialiased=True),
        )
    xx, xy, yy = splats.covariances.unbind(-1)
    found = {
        "centers": splats.centers,
        "inverses": torch.stack((yy, -xy, xx), -1) / splats.determinants[:, None],
        # What is fainter is not drawn.
        "opacities": torch.relu(splats.opacities[:, None] - 1 / 255),
        "covariances": splats.covariances,
    }
    front = (splats.depths > 0)[:, None]
    return {name: torch.where(front, value, 0.0) for name, value in found.items()}


def _render(backend: str, v: Values) -> Values:
    found = render(_gaussians(v), _cameras(v), backend, near=1e-6)
    return {"image": found.image, "alpha": found.alpha}


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
        dtypes=FLOAT32_ONLY,
    ),
)  # fmt: skip
