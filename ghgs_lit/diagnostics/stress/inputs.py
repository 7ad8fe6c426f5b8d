"""Random inputs of one case in float64. A family changes its own ingredient;
the others stay ordinary."""

import math

import torch
from torch import Generator, Tensor
from torch.nn import functional

F64 = torch.float64

UNITS = {"large": 1e3, "small": 1e-3}  #: Size of the scene by family
#: Factors on the values of an ingredient, by family.
FACTORS = {
    "depths": {"zero_depth": 0.0, "negative_depth": -1.0, "near_zero_depth": 1e-12, "huge_depth": 1e12},
    "quaternions": {"zero_quaternion": 0.0, "tiny_quaternion": 1e-20, "huge_quaternion": 1e20},
    "features": {"zero_features": 0.0, "tiny_features": 1e-20, "huge_features": 1e18},
}
#: Families that do not apply to points without a camera, with the reason.
NO_CAMERA = {
    "wide long skewed mirrored degenerate": "takes points, no camera",
    "behind on_camera beside": "relative to a camera",
}


def normal(g: Generator, *shape: int) -> Tensor:
    """Standard normal values of a shape."""
    return torch.randn(shape, generator=g, dtype=F64)


def uniform(g: Generator, low: float, high: float, *shape: int) -> Tensor:
    """Uniform values of a shape.

    Args:
        g: source of the numbers.
        low: least value.
        high: bound of the values.
        *shape: of the result.
    """
    return low + (high - low) * torch.rand(shape, generator=g, dtype=F64)


def directions(g: Generator, *shape: int) -> Tensor:
    """Unit vectors along the last axis of a shape."""
    return functional.normalize(normal(g, *shape), dim=-1)


def place(family: str, g: Generator) -> Tensor:
    """Middle of the scene in the world [3].

    Args:
        family: "shifted" (1e4 units from the origin instead of 0.1) and :data:`UNITS` change it.
        g: source of the numbers.
    """
    away = 1e4 if family == "shifted" else 0.1
    return directions(g, 3) * away * UNITS.get(family, 1.0)


def cameras(family: str, g: Generator, views: int, size: int, middle: Tensor) -> tuple[Tensor, Tensor]:
    """Cameras on a circle around the scene, two units from its middle (further if "long").

    Args:
        family: "wide", "long", "skewed", "mirrored", "degenerate" and :data:`UNITS` change them.
        g: source of the numbers.
        views: number of cameras.
        size: side of the images in pixels.
        middle: of the scene in the world [3].

    Returns:
        Lenses [v, 4] (two focal lengths and the principal point, in pixels), and poses [v, 3, 4]
        (world to camera).
    """
    unit = UNITS.get(family, 1.0)
    focal = {"wide": 0.1 * size, "long": 1e5}.get(family, float(uniform(g, 0.8, 1.2)) * size)
    distance = 2.0 * unit * (focal / size if family == "long" else 1.0)
    start = float(uniform(g, 0, 2 * math.pi))
    principal = size / 2 + uniform(g, -0.5, 0.5, views, 2)
    lenses = torch.cat((torch.tensor([[focal, 1.03 * focal]], dtype=F64).expand(views, 2), principal), 1)
    poses = torch.empty(views, 3, 4, dtype=F64)
    for v in range(views):
        rotation = _towards_middle(start + 2 * math.pi * v / views)
        if family == "skewed":
            rotation = rotation + 1e-3 * normal(g, 3, 3)
        if family == "mirrored":
            rotation = rotation * torch.tensor([[-1.0], [1.0], [1.0]], dtype=F64)
        if family == "degenerate":
            rotation = rotation[[1, 1, 2]]
        poses[v, :, :3] = rotation
        poses[v, :, 3] = -rotation @ middle + torch.tensor([0.0, 0.0, distance], dtype=F64)
    return lenses, poses


def _towards_middle(angle: float) -> Tensor:
    """Rotation [3, 3] of a camera at an angle around the scene, a little above it."""
    back = torch.tensor([math.sin(angle), 0.2, math.cos(angle)], dtype=F64)
    forward = -back / back.norm()
    right = torch.linalg.cross(forward, torch.tensor([0.0, 1.0, 0.0], dtype=F64))
    right = right / right.norm()
    return torch.stack((right, torch.linalg.cross(forward, right), forward))


def intrinsics(lenses: Tensor) -> Tensor:
    """Intrinsics [..., 3, 3] from lenses [..., 4]."""
    fx, fy, cx, cy = lenses.unbind(-1)
    zero = torch.zeros_like(fx)
    one = torch.ones_like(fx)
    return torch.stack((fx, zero, cx, zero, fy, cy, zero, zero, one), -1).unflatten(-1, (3, 3))


def matrices(lenses: Tensor, poses: Tensor) -> tuple[Tensor, Tensor]:
    """Matrices of cameras.

    Args:
        lenses: [..., 4], focal lengths and principal point in pixels.
        poses: [..., 3, 4], world to camera.

    Returns:
        Intrinsics [..., 3, 3] and extrinsics [..., 4, 4].
    """
    last = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=poses.dtype).expand(*poses.shape[:-2], 1, 4)
    return intrinsics(lenses), torch.cat((poses, last), -2)


def points(family: str, g: Generator, count: int, middle: Tensor, poses: Tensor | None = None) -> Tensor:
    """World points around the middle of a scene.

    Args:
        family: "duplicates", "collapsed", "far", "behind", "beside", "on_camera" and :data:`UNITS`
            change them.
        g: source of the numbers.
        count: number of points.
        middle: of the scene [3].
        poses: [v, 3, 4], world to camera; the first is what families relative to a camera need.
            None: these families change nothing.

    Returns:
        Points [count, 3].
    """
    around = middle + 0.3 * UNITS.get(family, 1.0) * normal(g, count, 3)
    if family == "duplicates":
        return around[torch.arange(count) // 2]
    if family == "collapsed":
        return around[:1].expand(count, 3).clone()
    if family == "far":
        return around + 1e6 * directions(g, 1, 3)
    if poses is None or family not in ("behind", "beside", "on_camera"):
        return around
    rotation = poses[0, :, :3]
    translation = poses[0, :, 3]
    center = -rotation.mT @ translation
    if family == "behind":
        return center - rotation[2] * uniform(g, 0.1, 3, count, 1) + 0.1 * normal(g, count, 3)
    if family == "on_camera":
        return center + 1e-6 * (rotation[2] * uniform(g, 0.5, 1, count, 1) + 0.2 * normal(g, count, 3))
    angle = uniform(g, 0, 2 * math.pi, count, 1)
    across = rotation[0] * angle.cos() + rotation[1] * angle.sin()
    depth = uniform(g, 0.7, 1.5, count, 1)
    return center + depth * (rotation[2] + uniform(g, 0.7, 1.2, count, 1) * across)


def depths(family: str, g: Generator, *shape: int) -> Tensor:
    """Depths of about two units.

    Args:
        family: "equal_depths", the depths of :data:`FACTORS` and :data:`UNITS` change them.
        g: source of the numbers.
        *shape: of the result.
    """
    values = uniform(g, 1.5, 2.5, *shape) * UNITS.get(family, 1.0)
    if family == "equal_depths":
        return torch.full_like(values, float(uniform(g, 1.5, 2.5)))
    return values * FACTORS["depths"].get(family, 1.0)


def quaternions(family: str, g: Generator, count: int) -> Tensor:
    """Quaternions [count, 4] of any length; the families of :data:`FACTORS` change it."""
    return normal(g, count, 4) * FACTORS["quaternions"].get(family, 1.0)


def scales(family: str, g: Generator, count: int, unit: float = 0.05) -> Tensor:
    """Scales of splats.

    Args:
        family: "thin", "zero_scale", "tiny_scale", "huge_scale" and :data:`UNITS` change them.
        g: source of the numbers.
        count: number of splats.
        unit: largest ordinary scale, in units of the scene.

    Returns:
        Scales [count, 3].
    """
    values = unit * uniform(g, 0.2, 1.0, count, 3) * UNITS.get(family, 1.0)
    if family == "thin":
        return values * torch.tensor([1.0, 1e-6, 1e-6], dtype=F64)
    factor = {"zero_scale": 0.0, "tiny_scale": 1e-12 / unit, "huge_scale": 1e4 / unit}
    return values * factor.get(family, 1.0)


def opacities(family: str, g: Generator, count: int) -> Tensor:
    """Opacities [count], 0.05 to 0.98; all 0 if "transparent", all 1 if "opaque"."""
    values = uniform(g, 0.05, 0.98, count)
    fixed = {"transparent": 0.0, "opaque": 1.0}
    return torch.full_like(values, fixed[family]) if family in fixed else values


def features(family: str, g: Generator, count: int, width: int) -> Tensor:
    """Features of tokens.

    Args:
        family: "parallel_features", "opposite_features" and those of :data:`FACTORS` change them.
        g: source of the numbers.
        count: number of tokens.
        width: of a feature.

    Returns:
        Features [count, width].
    """
    values = normal(g, count, width)
    if family == "parallel_features":
        return values[:1].expand(count, width).clone()
    if family == "opposite_features":
        return values[:1] * (1 - 2 * (torch.arange(count) % 2))[:, None]
    return values * FACTORS["features"].get(family, 1.0)


def raw(family: str, g: Generator, *shape: int) -> Tensor:
    """Raw values of a head of a shape: standard normal, or large where "saturated" or "extreme"."""
    values = normal(g, *shape)
    factor = {"saturated": 100.0, "extreme": 1e4}.get(family)
    return values if factor is None else values.sign() * factor * uniform(g, 0.5, 1.5, *shape)


def images(family: str, g: Generator, *shape: int) -> Tensor:
    """Images of a shape, uniform in 0 to 1; "constant", "black" and "out_of_range" change them."""
    values = uniform(g, 0, 1, *shape)
    if family == "constant":
        return torch.full_like(values, float(uniform(g, 0, 1)))
    return {"black": 0.0 * values, "out_of_range": 20 * values - 10}.get(family, values)


def disc(size: int) -> Tensor:
    """Mask [size, size] of a disc in the middle."""
    offset = torch.arange(size, dtype=F64) + 0.5 - size / 2
    return offset[:, None].square() + offset.square() < (0.3 * size) ** 2


def spoiled(family: str, g: Generator, masks: Tensor) -> Tensor:
    """Masks of a subject; families of masks spoil that of the last view.

    Args:
        family: "empty_mask", "one_pixel", "noise_mask" and "wrong_mask" change them.
        g: source of the numbers.
        masks: [v, h, w]; stays as it is.
    """
    masks = masks.clone()
    if family == "empty_mask":
        masks[-1] = False
    elif family == "one_pixel":
        row, column = (int(torch.randint(n, (), generator=g)) for n in masks.shape[1:])
        masks[-1] = False
        masks[-1, row, column] = True
    elif family == "noise_mask":
        masks[-1] = torch.rand(masks.shape[1:], generator=g) < 0.3
    elif family == "wrong_mask":
        masks[-1, masks.shape[1] // 2 :] = False
    return masks
