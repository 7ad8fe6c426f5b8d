"""Families of adversarial inputs, in float64. A family changes one ingredient of a case; the others stay
ordinary."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Generator, Tensor
from torch.nn import functional

F64 = torch.float64
Values = dict[str, Tensor]  #: Inputs or outputs [n, ...] of n cases by their names
Change = Callable[[Tensor, Generator], Tensor]


@dataclass(frozen=True)
class Family:
    """A kind of inputs.

    Attributes:
        ingredient: what it changes; None: it applies to every stage.
        text: describes the inputs.
        change: makes its values from ordinary ones; None: :func:`rig` and :func:`points` do, by its name.
    """

    ingredient: str | None
    text: str
    change: Change | None = None


def normal(g: Generator, *shape: int) -> Tensor:
    """Standard normal values of a shape."""
    return torch.randn(shape, generator=g, dtype=F64)


def uniform(g: Generator, low: float, high: float, *shape: int) -> Tensor:
    """Uniform values of a shape, from ``low`` to ``high``."""
    return low + (high - low) * torch.rand(shape, generator=g, dtype=F64)


def directions(g: Generator, *shape: int) -> Tensor:
    """Unit vectors along the last axis of a shape."""
    return functional.normalize(normal(g, *shape), dim=-1)


def _times(factor: float | list[float]) -> Change:
    return lambda values, g: values * torch.tensor(factor, dtype=F64)


def _all(number: float) -> Change:
    return lambda values, g: torch.full_like(values, number)


def _large(factor: float) -> Change:
    return lambda values, g: values.sign() * factor * uniform(g, 0.5, 1.5, *values.shape)


def _last_mask(change: Change) -> Change:
    """Changes the mask of the last view of masks [v, h, w]."""
    return lambda masks, g: torch.cat((masks[:-1], change(masks[-1:], g).bool()))


def _first(values: Tensor, g: Generator) -> Tensor:
    return values[:1].expand_as(values).clone()


def _alternating(values: Tensor, g: Generator) -> Tensor:
    return values[:1] * (1 - 2 * (torch.arange(len(values)) % 2))[:, None]


def _twice(values: Tensor, g: Generator) -> Tensor:
    return values[torch.arange(len(values)) // 2]


def _one_pixel(masks: Tensor, g: Generator) -> Tensor:
    pixels = torch.arange(masks.numel()).view_as(masks)
    return pixels == torch.randint(masks.numel(), (), generator=g)


def _noise(masks: Tensor, g: Generator) -> Tensor:
    return torch.rand(masks.shape, generator=g) < 0.3


def _one_color(images: Tensor, g: Generator) -> Tensor:
    return torch.full_like(images, float(images.flatten()[0]))


def _upper_half(masks: Tensor, g: Generator) -> Tensor:
    rows = torch.arange(masks.shape[1])[:, None]
    return masks & (rows < masks.shape[1] // 2)


FAMILIES = {
    "ordinary": Family(None, "values as in training"),
    "nan": Family(None, "one NaN in one input"),
    "inf": Family(None, "one infinity in one input"),
    "shifted": Family("place", "the world's origin is 1e4 m away"),
    "large": Family("place", "a scene in millimetres, or of 1000 times the size"),
    "small": Family("place", "a scene in kilometres"),
    "wide": Family("cameras", "focal lengths of a fisheye, 0.1 of the image"),
    "long": Family("cameras", "focal lengths of 1e5 px, the camera as far away"),
    "skewed": Family("cameras", "rotations that are orthogonal to 1e-3 only"),
    "mirrored": Family("cameras", "extrinsics with a determinant of -1"),
    "degenerate": Family("cameras", "rotations of rank 2"),
    "zero_depth": Family("depths", "depths of 0", _times(0.0)),
    "negative_depth": Family("depths", "depths below 0", _times(-1.0)),
    "near_zero_depth": Family("depths", "depths of 1e-12", _times(1e-12)),
    "huge_depth": Family("depths", "depths of 1e12", _times(1e12)),
    "equal_depths": Family("depths", "all depths equal", _all(2.0)),
    "behind": Family("points seen", "points behind the camera"),
    "on_camera": Family("points seen", "points 1e-6 from the camera's centre"),
    "beside": Family("points seen", "points beside the frame, whose splats reach into it"),
    "far": Family("points", "points 1e6 m away", lambda points, g: points + 1e6 * directions(g, 1, 3)),
    "duplicates": Family("points", "all points twice", _twice),
    "collapsed": Family("points", "all points at one place", _first),
    "few": Family("neighbors", "fewer points than k"),
    "single": Family("neighbors", "one point"),
    "zero_quaternion": Family("quaternions", "quaternions of 0", _times(0.0)),
    "tiny_quaternion": Family("quaternions", "quaternions of length 1e-20", _times(1e-20)),
    "huge_quaternion": Family("quaternions", "quaternions of length 1e20", _times(1e20)),
    "zero_scale": Family("scales", "scales of 0", _times(0.0)),
    "tiny_scale": Family("scales", "scales of 1e-12", _all(1e-12)),
    "huge_scale": Family("scales", "scales of 1e4 m", _all(1e4)),
    "thin": Family("scales", "scales with an aspect of 1e6", _times([1.0, 1e-6, 1e-6])),
    "transparent": Family("opacities", "opacities of 0", _all(0.0)),
    "opaque": Family("opacities", "opacities of 1", _all(1.0)),
    "stacked": Family("stacks", "thousands of splats on one line of sight"),
    "zero_features": Family("features", "features of 0", _times(0.0)),
    "tiny_features": Family("features", "features of length 1e-20", _times(1e-20)),
    "huge_features": Family("features", "features of length 1e18", _times(1e18)),
    "parallel_features": Family("features", "all features equal", _first),
    "opposite_features": Family("features", "pairs of opposite features", _alternating),
    "large_logits": Family("queries", "queries, keys 30 times as large as after a LayerNorm", _times(30.0)),
    "saturated": Family("raw values", "raw values of +-100", _large(100.0)),
    "extreme": Family("raw values", "raw values of +-1e4", _large(1e4)),
    "constant": Family("images", "images of one colour", _one_color),
    "black": Family("images", "black images", _times(0.0)),
    "identical": Family("images", "image and target are equal"),
    "out_of_range": Family("images", "colours from -10 to 10", lambda images, g: 20 * images - 10),
    "empty_mask": Family("masks", "a view without the subject", _last_mask(_times(0.0))),
    "one_pixel": Family("masks", "a mask of one pixel", _last_mask(_one_pixel)),
    "noise_mask": Family("masks", "a mask of noise", _last_mask(_noise)),
    "wrong_mask": Family("masks", "one mask half cut off", _last_mask(_upper_half)),
    "kicked": Family("weights", "after a step of a learning rate of 10"),
}  # fmt: skip

UNITS = {"large": 1e3, "small": 1e-3}  #: Size of the scene by family
COUNTS = {"few": 4, "single": 1}  #: Numbers of points by family


def vary(ingredient: str, family: str, ordinary: Tensor, g: Generator) -> Tensor:
    """Values of an ingredient.

    Args:
        ingredient: of which ``ordinary`` is.
        family: changes the values if it is one of this ingredient.
        ordinary: values as in training.
        g: source of further numbers.
    """
    chosen = FAMILIES[family]
    if chosen.ingredient != ingredient or chosen.change is None:
        return ordinary
    return chosen.change(ordinary, g)


def depths(family: str, g: Generator, *shape: int) -> Tensor:
    """Depths of about two units of the scene."""
    return vary("depths", family, uniform(g, 1.5, 2.5, *shape) * UNITS.get(family, 1.0), g)


def rig(family: str, g: Generator, views: int, size: int) -> Values:
    """Cameras on a circle around the middle of a scene, two units from it (further if "long").

    Args:
        family: of the case.
        g: source of the numbers.
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
    lenses = torch.empty(views, 4, dtype=F64)
    lenses[:, 0] = focal
    lenses[:, 1] = 1.03 * focal
    lenses[:, 2:] = size / 2 + uniform(g, -0.5, 0.5, views, 2)
    angles = uniform(g, 0, 2 * math.pi, 1) + 2 * math.pi * torch.arange(views) / views
    forward = -functional.normalize(torch.stack((angles.sin(), angles * 0 + 0.2, angles.cos()), 1))
    right = functional.normalize(torch.linalg.cross(forward, torch.tensor([[0.0, 1.0, 0.0]], dtype=F64)))
    rotations = torch.stack((right, torch.linalg.cross(forward, right), forward), 1)
    if family == "skewed":
        rotations = rotations + 1e-3 * normal(g, views, 3, 3)
    if family == "mirrored":
        rotations = rotations * torch.tensor([[-1.0], [1.0], [1.0]], dtype=F64)
    if family == "degenerate":
        rotations = rotations[:, [1, 1, 2]]
    shifts = -rotations @ middle + torch.tensor([0.0, 0.0, distance], dtype=F64)
    return {"lenses": lenses, "poses": torch.cat((rotations, shifts[..., None]), 2), "middle": middle}


def matrices(v: Values, prefix: str = "") -> tuple[Tensor, Tensor]:
    """Intrinsics [..., 3, 3] and extrinsics [..., 4, 4] of :func:`rig`.

    Args:
        v: ``lenses`` and ``poses``.
        prefix: of these names.
    """
    lenses = v[f"{prefix}lenses"]
    poses = v[f"{prefix}poses"]
    focal, center = lenses.split(2, -1)
    last = torch.tensor([[0.0, 0.0, 1.0]], dtype=lenses.dtype).expand(*lenses.shape[:-1], 1, 3)
    intrinsics = torch.cat((torch.cat((focal.diag_embed(), center[..., None]), -1), last), -2)
    last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=poses.dtype).expand(*poses.shape[:-2], 1, 4)
    return intrinsics, torch.cat((poses, last), -2)


def _ring(g: Generator, count: int) -> Tensor:
    angles = uniform(g, 0, 2 * math.pi, count)
    across = uniform(g, 0.7, 1.2, count)
    points = torch.stack((across * angles.cos(), across * angles.sin(), torch.ones(count, dtype=F64)), 1)
    return uniform(g, 0.7, 1.5, count, 1) * points


#: Points in the axes of a camera, by family.
_SEEN = {
    "behind": lambda g, n: torch.cat((0.1 * normal(g, n, 2), -uniform(g, 0.1, 3, n, 1)), 1),
    "on_camera": lambda g, n: 1e-6 * torch.cat((0.2 * normal(g, n, 2), uniform(g, 0.5, 1, n, 1)), 1),
    "beside": _ring,
}


def points(family: str, g: Generator, count: int, scene: Values) -> Tensor:
    """World points [count, 3] around the middle of a scene, or where its first camera has them.

    Args:
        family: of the case.
        g: source of the numbers.
        count: number of points.
        scene: of :func:`rig`.
    """
    if family in _SEEN:
        pose = scene["poses"][0]
        return (_SEEN[family](g, count) - pose[:, 3]) @ pose[:, :3]
    around = scene["middle"] + 0.3 * UNITS.get(family, 1.0) * normal(g, count, 3)
    return vary("points", family, around, g)


def sphere(family: str, g: Generator, views: int, size: int, target: bool = False) -> Values:
    """Images, masks and true depths of a sphere of 0.5 units.

    Args:
        family: of the case.
        g: source of the numbers.
        views: number v of input views.
        size: side s of the images in pixels.
        target: whether there is a target view, too.

    Returns:
        ``images`` [v, 3, s, s], ``masks`` and ``truth`` [v, s, s] (true depths, 0 outside the
        sphere), and what :func:`rig` has; with a target ``target`` [1, 3, s, s],
        ``target_lenses`` and ``target_poses``.
    """
    scene = rig(family, g, views + target, size)
    intrinsics, extrinsics = matrices(scene)
    centers = torch.arange(size, dtype=F64) + 0.5
    pixels = torch.cartesian_prod(centers, centers).view(size, size, 2).flip(-1)
    rays = functional.pad(pixels, (0, 1), value=1.0) @ torch.linalg.inv(intrinsics).mT[:, None]
    center = (extrinsics[:, :3, :3] @ scene["middle"] + extrinsics[:, :3, 3])[:, None, None]
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
