"""Stages of geometry: cameras, bounds, maps and the points of tokens."""

import torch
from torch import Generator, Tensor

from ghgs_lit.diagnostics.stress import families
from ghgs_lit.diagnostics.stress.families import (
    COUNTS,
    UNITS,
    Values,
    matrices,
    normal,
    rig,
    sphere,
    uniform,
    vary,
)
from ghgs_lit.diagnostics.stress.measure import Stage
from ghgs_lit.geometry.frame import Frame, to_world
from ghgs_lit.geometry.masks import relative_bounds, relative_depth
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import project, sample, unproject, world_to_camera
from ghgs_lit.geometry.unprojection import subject_tokens
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.method.bounds.rays import depths_in_box, ray_directions
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.types import Batch, Cameras, DepthBounds, DepthMaps

SIZE = 16  #: Side of images in pixels
CAMERAS = ("place", "cameras")  #: Ingredients of cameras, and of points before them
SEEN = (*CAMERAS, "points", "points seen")


def cameras_of(v: Values, size: int, prefix: str = "") -> Cameras:
    """Cameras of :func:`families.rig` for square images."""
    return Cameras(*matrices(v, prefix), size, size)


def batch_of(v: Values) -> Batch:
    """Batch of stacked cases of :func:`families.sphere` without targets."""
    return Batch(v["images"], v["masks"], cameras_of(v, v["images"].shape[-1]))


def points_case(family: str, g: Generator) -> Values:
    """Points before the cameras of a rig."""
    scene = rig(family, g, 1, SIZE)
    count = COUNTS.get(family, 20)
    return {**scene, "points": families.points(family, g, count, scene)}


def _project(v: Values) -> Values:
    pixels, z = project(v["points"], *matrices(v))
    camera = world_to_camera(v["points"], matrices(v)[1])
    return {"camera": camera, "pixels": torch.where(z[..., None] > 0, pixels, 0.0)}


def _pixels(family: str, g: Generator) -> Values:
    scene = rig(family, g, 1, SIZE)
    return {**scene, "pixels": uniform(g, 0, SIZE, 16, 2), "depth": families.depths(family, g, 16)}


def _boxes(family: str, g: Generator) -> Values:
    """A box around the scene, and which rays do not nearly graze it, which is a decision."""
    scene = rig(family, g, 1, 4)
    half = 0.7 * UNITS.get(family, 1.0) * uniform(g, 1, 1.1, 3)
    rays = ray_directions(cameras_of(scene, 4))
    centers = cameras_of(scene, 4).centers[:, None, None]
    hits = []
    for share in (0.9, 1.1):
        faces = [(scene["middle"] + sign * share * half - centers) / rays for sign in (-1, 1)]
        hits.append(torch.minimum(*faces).amax(-1) < torch.maximum(*faces).amin(-1))
    return {**scene, "half": half, "clear": hits[0] == hits[1]}


def _rays(v: Values) -> Values:
    cameras = cameras_of(v, 4)
    with exact("cpu"):  # as in the stage
        bounds = depths_in_box(cameras, v["middle"] - v["half"], v["middle"] + v["half"])
        near, far = (torch.where(v["clear"], x, 0.0) for x in (bounds.near, bounds.far))
        return {"directions": ray_directions(cameras), "near": near, "far": far}


def _bounds(v: Values) -> Values:
    """Bounds of the subject's pixels, computed in the subject's frame as the model does, and whether the
    true surface is outside of them: infinite."""
    batch = batch_of(v)
    frame = Frame.of(batch)
    bounds = VisualHull(dilation=0.02)(frame.enter(batch))
    metre = frame.metre.to(v["truth"])[:, None, None, None]
    near = bounds.near * metre
    far = bounds.far * metre
    seen = v["masks"] & (v["truth"] > 0)
    slack = 0.05 * v["truth"]
    is_outside = seen & ((v["truth"] < near - slack) | (v["truth"] > far + slack))
    near = torch.where(is_outside, torch.inf, near)
    return {"near": torch.where(v["masks"], near, 0.0), "far": torch.where(v["masks"], far, 0.0)}


def _cells(v: Values) -> Tensor:
    """Condition number by which bounds, decisions on a grid, may differ by one cell of 1/20 of the depth."""
    return torch.full((len(v["images"]),), 0.05 / (100 * torch.finfo(torch.float32).eps))


def _frame(v: Values) -> Values:
    batch = batch_of(v)
    frame = Frame.of(batch)
    element = torch.arange(len(v["points"]))[:, None]
    world = to_world(v["points"], element, frame.in_world(v["points"].dtype))
    return {"extrinsics": frame.enter(batch).cameras.extrinsics, "world": world}


def _maps(family: str, g: Generator) -> Values:
    return points_case(family, g) | {"maps": vary("images", family, uniform(g, 0, 1, 3, SIZE, SIZE), g)}


def _sample(v: Values) -> Values:
    pixels, z = project(v["points"], *matrices(v))
    image = torch.arange(len(v["maps"]))[:, None].expand(v["points"].shape[:2])
    return {"values": sample(v["maps"], image, torch.where(z[..., None] > 0, pixels, 1e9))}


def _near_surface(family: str, g: Generator) -> Values:
    values = sphere(family, g, 3, SIZE)
    return {**values, "near": values["truth"] - 0.2, "far": values["truth"] + 0.2}


def _photo(v: Values) -> Values:
    """Disagreement, whose error relates to 1 however small the agreement is."""
    return {"disagreement": 1 - photo_consistency(batch_of(v), DepthBounds(v["near"], v["far"]), 3)}


def _depth_maps(family: str, g: Generator) -> Values:
    offsets = torch.arange(SIZE) + 0.5 - SIZE / 2
    disc = offsets[:, None].square() + offsets.square() < (0.3 * SIZE) ** 2
    depth = families.depths(family, g, 2, SIZE, SIZE)
    return {"depth": depth, "far": depth + 0.3, "masks": vary("masks", family, disc.expand(2, -1, -1), g)}


def _tokens(v: Values) -> Values:
    maps = DepthMaps(v["depth"], v["masks"], torch.ones_like(v["depth"]))
    pixels, depth, valid = subject_tokens(maps, 4)
    return {"pixels": torch.where(valid[..., None], pixels, 0.0), "depth": torch.where(valid, depth, 0.0)}


def _relative(v: Values) -> Values:
    bounds = relative_bounds(DepthBounds(v["depth"], v["far"]), v["masks"])
    return {"relative": relative_depth(v["depth"], v["masks"]), "bounds": bounds}


_OUTSIDE_FRAME = ("wide", "degenerate")  # the subject is smaller than a pixel, or nowhere in the frame
_HOLDS = "a sum of a few products a coordinate; each rounds once, and the inputs' rounding is in kappa"
_REFUSED = "cameras that are not finite are refused before this stage"

GEOMETRY = [
    Stage(
        "projection", SEEN, points_case, _project, 20, _HOLDS,
        gradients=("points", "lenses", "poses"), steady=("middle",),
        silent="a point behind the camera has no pixel",
    ),
    Stage(
        "unprojection", (*CAMERAS, "depths"), _pixels,
        lambda v: {"points": unproject(v["pixels"], v["depth"], *matrices(v))}, 20, _HOLDS,
        gradients=("pixels", "depth", "lenses", "poses"), steady=("middle",),
        silent="an infinite focal length is a ray along the axis; the model refuses it",
    ),
    Stage(
        "rays and box", CAMERAS, _boxes, _rays, 50,
        "as projection, and a division by a component of the direction", silent="NaN loses every comparison",
    ),
    Stage(
        "bounds and hull", (*CAMERAS, "masks"), lambda family, g: sphere(family, g, 4, 24), _bounds, 100,
        "decisions on a grid: one cell may differ (kappa)",
        steady=("truth", "middle", "images"), seeds=32, kappa=_cells, without=_OUTSIDE_FRAME, silent=_REFUSED,
    ),
    Stage(
        "subject frame", (*CAMERAS, "masks"),
        lambda family, g: sphere(family, g, 3, SIZE) | {"points": normal(g, 16, 3)}, _frame, 20,
        "all of it in float64, rounded once", gradients=("points",), steady=("truth", "middle", "images"),
        without=_OUTSIDE_FRAME, silent=_REFUSED,
    ),
    Stage(
        "samples of maps", (*SEEN, "images"), _maps, _sample, 20,
        "a mean of four pixels; their shares lose the digits of a pixel's place (kappa)",
        steady=("middle",), seeds=64, without=("nan", "inf"),  # its callers clean their maps
    ),
    Stage(
        "photo-consistency", (*CAMERAS, "images", "masks"), _near_surface, _photo, 100,
        "exp of a colour difference over 0.1, of bilinear samples at a projected place",
        steady=("truth", "middle"), seeds=64, silent="agreement of what cannot be compared is 0",
    ),
    Stage(
        "token points", ("depths", "masks"), _depth_maps, _tokens, 50, "means of 16 values",
        gradients=("depth",), silent="only depths inside the mask count",
    ),
    Stage(
        "relative depths", ("depths", "masks"), _depth_maps, _relative, 50, "means of 256 values",
        silent="only depths inside the mask count",
    ),
]  # fmt: skip
