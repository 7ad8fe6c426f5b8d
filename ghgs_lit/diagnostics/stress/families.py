"""Inputs of the stages in float64: ordinary ones, and families of adversarial ones. A family changes one
ingredient of a case; the others stay ordinary."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Generator, Tensor
from torch.nn import functional

from ghgs_lit.geometry.projection import homogeneous_centers, world_to_camera
from ghgs_lit.types import Batch, Cameras

F64 = torch.float64
Values = dict[str, Tensor]  #: Inputs or outputs [n, ...] of n cases by their names


class Family(NamedTuple):
    """A kind of inputs."""

    ingredient: str | None  #: what it changes; None: it applies to every stage
    text: str  #: describes the inputs
    change: Callable[[Tensor, Generator], Tensor] | None = None
    """Turns an ordinary ingredient into that of the family; None: the code that makes the inputs does it."""


def normal(g: Generator, *shape: int) -> Tensor:
    """Standard normal values of a shape."""
    return torch.randn(shape, generator=g, dtype=F64)


def uniform(g: Generator, low: float, high: float, *shape: int) -> Tensor:
    """Uniform values of a shape, from ``low`` to ``high``."""
    return low + (high - low) * torch.rand(shape, generator=g, dtype=F64)


def directions(g: Generator, *shape: int) -> Tensor:
    """Unit vectors along the last axis of a shape."""
    return functional.normalize(normal(g, *shape), dim=-1)


def _column(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)[:, None]


def _ring(x: Tensor, g: Generator) -> Tensor:
    angles = uniform(g, 0, 2 * math.pi, len(x))
    across = uniform(g, 0.7, 1.2, len(x))
    points = torch.stack((across * angles.cos(), across * angles.sin(), torch.ones_like(across)), 1)
    return uniform(g, 0.7, 1.5, len(x), 1) * points


def _behind(x: Tensor, g: Generator) -> Tensor:
    return torch.cat((0.1 * normal(g, len(x), 2), -uniform(g, 0.1, 3, len(x), 1)), 1)


def _on_camera(x: Tensor, g: Generator) -> Tensor:
    return 1e-6 * torch.cat((0.2 * normal(g, len(x), 2), uniform(g, 0.5, 1, len(x), 1)), 1)


def _not_orthogonal(x: Tensor, g: Generator) -> Tensor:
    return x + 1e-3 * normal(g, *x.shape)


def _alternating(x: Tensor, g: Generator) -> Tensor:
    return x[:1] * (1 - 2 * (torch.arange(len(x)) % 2))[:, None]


def _large(factor: float) -> Callable[[Tensor, Generator], Tensor]:
    return lambda x, g: x.sign() * factor * uniform(g, 0.5, 1.5, *x.shape)


def _last_mask(change: Callable[[Tensor, Generator], Tensor]) -> Callable[[Tensor, Generator], Tensor]:
    """Change of the mask of the last view of masks [v, h, w]."""
    return lambda x, g: torch.cat((x[:-1], change(x[-1:], g)))


def _one_pixel(x: Tensor, g: Generator) -> Tensor:
    pixels = torch.arange(x.numel()).view_as(x)
    return pixels == torch.randint(x.numel(), (), generator=g)


def _noise(x: Tensor, g: Generator) -> Tensor:
    return torch.rand(x.shape, generator=g) < 0.3


def _upper_half(x: Tensor, g: Generator) -> Tensor:
    rows = torch.arange(x.shape[1])[:, None]
    return x & (rows < len(rows) // 2)


FAMILIES = {
    "ordinary": Family(None, "values as in training"),
    "nan": Family(None, "one NaN in one input"),
    "inf": Family(None, "one infinity in one input"),
    "shifted": Family("place", "the world's origin is 1e4 m away"),
    "large": Family("place", "a scene in millimetres, or of 1000 times the size"),
    "small": Family("place", "a scene in kilometres"),
    "wide": Family("cameras", "focal lengths of a fisheye, 0.1 of the image"),
    "long": Family("cameras", "focal lengths of 1e5 px, the camera as far away"),
    "skewed": Family("cameras", "rotations orthogonal to 1e-3 only", _not_orthogonal),
    "mirrored": Family("cameras", "extrinsics with a determinant of -1", lambda x, g: x * _column(-1, 1, 1)),
    "degenerate": Family("cameras", "rotations of rank 2", lambda x, g: x[:, [1, 1, 2]]),
    "zero_depth": Family("depths", "depths of 0", lambda x, g: 0 * x),
    "negative_depth": Family("depths", "depths below 0", lambda x, g: -x),
    "near_zero_depth": Family("depths", "depths of 1e-12", lambda x, g: 1e-12 * x),
    "huge_depth": Family("depths", "depths of 1e12", lambda x, g: 1e12 * x),
    "equal_depths": Family("depths", "all depths equal", lambda x, g: torch.full_like(x, 2)),
    "behind": Family("points seen", "points behind the camera", _behind),
    "on_camera": Family("points seen", "points 1e-6 from the camera's centre", _on_camera),
    "beside": Family("points seen", "points beside the frame, whose splats reach into it", _ring),
    "far": Family("points", "points 1e6 m away", lambda x, g: x + 1e6 * directions(g, 1, 3)),
    "duplicates": Family("points", "all points twice", lambda x, g: x[torch.arange(len(x)) // 2]),
    "collapsed": Family("points", "all points at one place", lambda x, g: x[:1].repeat(len(x), 1)),
    "few": Family("neighbors", "fewer points than k"),
    "single": Family("neighbors", "one point"),
    "zero_quaternion": Family("quaternions", "quaternions of 0", lambda x, g: 0 * x),
    "tiny_quaternion": Family("quaternions", "quaternions of length 1e-20", lambda x, g: 1e-20 * x),
    "huge_quaternion": Family("quaternions", "quaternions of length 1e20", lambda x, g: 1e20 * x),
    "zero_scale": Family("scales", "scales of 0", lambda x, g: 0 * x),
    "tiny_scale": Family("scales", "scales of 1e-12", lambda x, g: torch.full_like(x, 1e-12)),
    "huge_scale": Family("scales", "scales of 1e4 m", lambda x, g: torch.full_like(x, 1e4)),
    "thin": Family("scales", "scales with an aspect of 1e6", lambda x, g: x * _column(1, 1e-6, 1e-6).T),
    "transparent": Family("opacities", "opacities of 0", lambda x, g: torch.zeros_like(x)),
    "opaque": Family("opacities", "opacities of 1", lambda x, g: torch.ones_like(x)),
    "stacked": Family("stacks", "thousands of splats on one line of sight"),
    "zero_features": Family("features", "features of 0", lambda x, g: 0 * x),
    "tiny_features": Family("features", "features of length 1e-20", lambda x, g: 1e-20 * x),
    "huge_features": Family("features", "features of length 1e18", lambda x, g: 1e18 * x),
    "parallel_features": Family("features", "all features equal", lambda x, g: x[:1].repeat(len(x), 1)),
    "opposite_features": Family("features", "pairs of opposite features", _alternating),
    "large_logits": Family("queries", "queries and keys 30 times those of a LayerNorm", lambda x, g: 30 * x),
    "saturated": Family("raw values", "raw values of +-100", _large(100.0)),
    "extreme": Family("raw values", "raw values of +-1e4", _large(1e4)),
    "constant": Family("images", "images of one colour", lambda x, g: x.flatten()[:1].expand(x.shape)),
    "black": Family("images", "black images", lambda x, g: 0 * x),
    "identical": Family("images", "image and target are equal"),
    "out_of_range": Family("images", "colours from -10 to 10", lambda x, g: 20 * x - 10),
    "empty_mask": Family("masks", "a view without the subject", _last_mask(lambda x, g: torch.zeros_like(x))),
    "one_pixel": Family("masks", "a mask of one pixel", _last_mask(_one_pixel)),
    "noise_mask": Family("masks", "a mask of noise", _last_mask(_noise)),
    "wrong_mask": Family("masks", "one mask half cut off", _last_mask(_upper_half)),
    "kicked": Family("weights", "after a step of a learning rate of 10"),
}  # fmt: skip

UNITS = {"large": 1e3, "small": 1e-3}  #: Size of the scene by family
COUNTS = {"few": 4, "single": 1}  #: Numbers of points by family


def vary(ingredient: str, family: str, ordinary: Tensor, g: Generator) -> Tensor:
    """Values of an ingredient for a case of a family, which changes those of its own ingredient only.

    Args:
        ingredient: of the values.
        family: of the case.
        ordinary: values as in training.
        g: of the random numbers.
    """
    chosen = FAMILIES[family]
    is_changed = chosen.ingredient == ingredient and chosen.change is not None
    return chosen.change(ordinary, g) if is_changed else ordinary


def depths(family: str, g: Generator, *shape: int) -> Tensor:
    """Depths of about two units of the scene, of a shape."""
    return vary("depths", family, uniform(g, 1.5, 2.5, *shape) * UNITS.get(family, 1.0), g)


def rig(family: str, g: Generator, views: int, size: int) -> Values:
    """Cameras on a circle around the middle of a scene, two units from it (further away for ``long``).

    Args:
        family: of the case.
        g: of the random numbers.
        views: number of cameras.
        size: side of the images in pixels.

    Returns:
        ``lenses`` [views, 4] (two focal lengths and the principal point, in pixels), ``poses``
        [views, 3, 4] (world to camera) and ``middle`` [3].
    """
    unit = UNITS.get(family, 1.0)
    middle = directions(g, 3) * (1e4 if family == "shifted" else 0.1) * unit
    focal = {"wide": 0.1 * size, "long": 1e5}.get(family, float(uniform(g, 0.8, 1.2)) * size)
    distance = 2.0 * unit * (focal / size if family == "long" else 1.0)
    centers = size / 2 + uniform(g, -0.5, 0.5, views, 2)
    lenses = torch.cat((_column(focal, 1.03 * focal).T.expand(views, 2), centers), 1)
    angles = uniform(g, 0, 2 * math.pi, 1) + 2 * math.pi * torch.arange(views) / views
    forward = -functional.normalize(torch.stack((angles.sin(), angles * 0 + 0.2, angles.cos()), 1))
    right = functional.normalize(torch.linalg.cross(forward, _column(0, 1, 0).T))
    upright = torch.stack((right, torch.linalg.cross(forward, right), forward), 1)
    rotations = vary("cameras", family, upright, g)
    shifts = _column(0, 0, distance) - (rotations @ middle)[..., None]
    return {"lenses": lenses, "poses": torch.cat((rotations, shifts), 2), "middle": middle}


def _square(rows: Tensor) -> Tensor:
    last = torch.eye(rows.shape[-1], dtype=rows.dtype)[-1:]
    return torch.cat((rows, last.expand(*rows.shape[:-2], 1, -1)), -2)


def matrices(v: Values, prefix: str = "") -> tuple[Tensor, Tensor]:
    """Intrinsics [..., 3, 3] and extrinsics [..., 4, 4] of :func:`rig`.

    Args:
        v: ``lenses`` and ``poses``.
        prefix: of these names.
    """
    focal, center = v[f"{prefix}lenses"].split(2, -1)
    intrinsics = torch.cat((focal.diag_embed(), center[..., None]), -1)
    return _square(intrinsics), _square(v[f"{prefix}poses"])


def cameras_of(v: Values, size: int, prefix: str = "") -> Cameras:
    """Cameras of :func:`rig` for square images of a size."""
    return Cameras(*matrices(v, prefix), size, size)


def points(family: str, g: Generator, count: int, scene: Values) -> Tensor:
    """World points [count, 3] around the middle of a scene, or placed relative to its first camera.

    Args:
        family: of the case.
        g: of the random numbers.
        count: number of points.
        scene: of :func:`rig`.
    """
    if FAMILIES[family].ingredient == "points seen":
        pose = scene["poses"][0]
        in_camera = FAMILIES[family].change(torch.empty(count, 3), g)
        return (in_camera - pose[:, 3]) @ pose[:, :3]
    around = scene["middle"] + 0.3 * UNITS.get(family, 1.0) * normal(g, count, 3)
    return vary("points", family, around, g)


def scene_points(family: str, g: Generator) -> Values:
    """:func:`rig` of one camera with 16 x 16 pixels, and ``points``."""
    scene = rig(family, g, 1, 16)
    return {**scene, "points": points(family, g, COUNTS.get(family, 20), scene)}


def sphere(family: str, g: Generator, views: int, size: int, target: bool = False) -> Values:
    """Images, masks and true depths of a sphere with a radius of 0.5 units.

    Args:
        family: of the case.
        g: of the random numbers.
        views: number v of input views.
        size: side s of the images in pixels.
        target: whether to add a target view.

    Returns:
        ``images`` [v, 3, s, s], ``masks`` and ``truth`` [v, s, s] (true depths, 0 outside the
        sphere), and the values of :func:`rig`; with a target also ``target`` [1, 3, s, s],
        ``target_lenses`` and ``target_poses``.
    """
    scene = rig(family, g, views + target, size)
    cameras = cameras_of(scene, size)
    centers = homogeneous_centers(size, size, cameras.intrinsics)
    rays = centers @ torch.linalg.inv(cameras.intrinsics).mT[:, None]
    center = world_to_camera(scene["middle"].expand(views + target, 3), cameras.extrinsics)[:, None, None]
    a = rays.square().sum(-1)
    b = (rays * center).sum(-1)
    root = b * b - a * (center.square().sum(-1) - (0.5 * UNITS.get(family, 1.0)) ** 2)
    hit = root > 0
    depth = torch.where(hit, (b - root.clamp(min=0).sqrt()) / a, 0.0)
    images = vary("images", family, uniform(g, 0, 1, views + target, 3, size, size), g) * hit[:, None]
    values = {"images": images[:views], "truth": depth[:views], "middle": scene["middle"]}
    values["masks"] = vary("masks", family, hit[:views], g)
    for name in ("lenses", "poses"):
        values[name] = scene[name][:views]
        if target:
            values[f"target_{name}"] = scene[name][views:]
    if target:
        values["target"] = images[:1] if family == "identical" else images[views:]
    return values


def batch_of(v: Values) -> Batch:
    """Batch of stacked cases of :func:`sphere`, without targets."""
    return Batch(v["images"], v["masks"], cameras_of(v, v["images"].shape[-1]))
