"""Stages of geometry: bounds, projection, unprojection, token points, padding,
photo-consistency."""

import torch
from torch import Generator, Tensor

from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import Stage, Values
from ghgs_lit.geometry.frame import Frame, to_world
from ghgs_lit.geometry.masks import relative_bounds, relative_depth
from ghgs_lit.geometry.padding import pad_to_patches
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import project, sample, unproject, world_to_camera
from ghgs_lit.geometry.unprojection import subject_tokens
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.method.bounds.rays import depths_in_box, ray_directions
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.types import Batch, Cameras, DepthBounds, DepthMaps

_SIZE = 12


def _rig(family: str, g: Generator, views: int = 1, size: int = _SIZE) -> Values:
    """Cameras around the middle of a scene.

    Args:
        family: of the case.
        g: source of the numbers.
        views: number of cameras.
        size: side of the images in pixels.

    Returns:
        ``lenses`` [views, 4], ``poses`` [views, 3, 4] and ``middle`` [3].
    """
    middle = inputs.place(family, g)
    lenses, poses = inputs.cameras(family, g, views, size, middle)
    return {"lenses": lenses, "poses": poses, "middle": middle}


def cameras_of(values: Values, size: int = _SIZE) -> Cameras:
    """Cameras of stacked cases.

    Args:
        values: ``lenses`` [..., 4] and ``poses`` [..., 3, 4].
        size: side of the images in pixels.
    """
    return Cameras(*inputs.matrices(values["lenses"], values["poses"]), size, size)


def _project_inputs(family: str, g: Generator) -> Values:
    rig = _rig(family, g)
    return {**rig, "points": inputs.points(family, g, 16, rig["middle"], rig["poses"])}


def _project(v: Values) -> Values:
    intrinsics, extrinsics = inputs.matrices(v["lenses"], v["poses"])
    pixels, z = project(v["points"], intrinsics, extrinsics)
    camera = world_to_camera(v["points"], extrinsics)
    return {"camera": camera, "pixels": torch.where(z[..., None] > 0, pixels, 0.0)}


def _unproject_inputs(family: str, g: Generator) -> Values:
    rig = _rig(family, g)
    return {**rig, "pixels": inputs.uniform(g, 0, _SIZE, 16, 2), "depth": inputs.depths(family, g, 16)}


def _unproject_slowly(v: Values) -> Values:
    homogeneous = torch.cat((v["pixels"], torch.ones_like(v["pixels"][..., :1])), -1)
    intrinsics = inputs.intrinsics(v["lenses"])
    camera = torch.einsum("nvij,npj->npi", torch.linalg.inv(intrinsics), homogeneous)
    centered = camera * v["depth"][..., None] - v["poses"][..., 3]
    return {"points": torch.einsum("nvji,npj->npi", v["poses"][..., :3], centered)}


def _rays_inputs(family: str, g: Generator) -> Values:
    rig = _rig(family, g, size=4)
    half = 0.7 * inputs.UNITS.get(family, 1.0)
    half = half + inputs.uniform(g, 0, 0.1 * half, 3)
    cameras = Cameras(*inputs.matrices(rig["lenses"], rig["poses"]), 4, 4)
    inner, outer = (_hits(cameras, rig["middle"], half * share) for share in (0.9, 1.1))
    return {**rig, "half": half, "clear": inner == outer}


def _hits(cameras: Cameras, middle: Tensor, half: Tensor) -> Tensor:
    """Whether the rays of pixels hit a box [..., h, w], by the slabs between its faces.

    Args:
        cameras: whose rays.
        middle: of the box [3].
        half: of its edges [3].
    """
    directions = ray_directions(cameras)
    centers = cameras.centers[:, None, None]
    faces = [(middle + sign * half - centers) / directions for sign in (-1, 1)]
    return torch.minimum(*faces).amax(-1) < torch.maximum(*faces).amin(-1)


def _rays(v: Values) -> Values:
    """Rays, and their depths in the box except where they nearly graze it, which is a decision."""
    cameras = cameras_of(v, 4)
    with exact("cpu"):  # as in the stage
        bounds = depths_in_box(cameras, v["middle"] - v["half"], v["middle"] + v["half"])
        near, far = (torch.where(v["clear"], x, 0.0) for x in (bounds.near, bounds.far))
        return {"directions": ray_directions(cameras), "near": near, "far": far}


def scene(family: str, g: Generator, views: int, size: int, target: bool = False) -> Values:
    """Photographs, masks and true depths of a sphere of 0.5 units.

    Args:
        family: of the case.
        g: source of the numbers.
        views: number v of input views.
        size: side s of the images in pixels.
        target: whether there is a target view, too.

    Returns:
        ``images`` [v, 3, s, s], ``masks`` and ``truth`` [v, s, s] (true depths, 0 beside the
        sphere), ``lenses`` [v, 4], ``poses`` [v, 3, 4] and ``middle`` [3]; with a target ``target``
        [1, 3, s, s], ``target_lenses`` and ``target_poses``.
    """
    rig = _rig(family, g, views + target, size)
    unit = inputs.UNITS.get(family, 1.0)
    intrinsics, extrinsics = inputs.matrices(rig["lenses"], rig["poses"])
    rows, columns = torch.meshgrid(*[torch.arange(size, dtype=torch.float64) + 0.5] * 2, indexing="ij")
    pixels = torch.stack((columns, rows, torch.ones_like(rows)), -1)
    rays = torch.einsum("vij,hwj->vhwi", torch.linalg.inv(intrinsics), pixels)
    center = extrinsics[:, :3, :3] @ rig["middle"] + extrinsics[:, :3, 3]
    a = rays.square().sum(-1)
    b = (rays * center[:, None, None]).sum(-1)
    radius = 0.5 * unit
    root = b * b - a * (center.square().sum(-1) - radius**2)[:, None, None]
    depth = (b - root.clamp(min=0).sqrt()) / a
    masks = inputs.spoiled(family, g, (root > 0)[:views])
    images = inputs.images(family, g, views + target, 3, size, size)
    images = images * (root > 0)[:, None]
    values = {
        "images": images[:views],
        "masks": masks,
        "lenses": rig["lenses"][:views],
        "poses": rig["poses"][:views],
        "truth": torch.where(root > 0, depth, 0.0)[:views],
        "middle": rig["middle"],
    }
    if target:
        values["target"] = images[:1] if family == "identical" else images[views:]
        values |= {f"target_{name}": rig[name][views:] for name in ("lenses", "poses")}
    return values


def batch_of(v: Values) -> Batch:
    """Batch of stacked cases without targets, from ``images``, ``masks``,
    ``lenses`` and ``poses``."""
    return Batch(v["images"], v["masks"], cameras_of(v, v["images"].shape[-1]))


_HULL = VisualHull(dilation=0.02)


def _bounds(v: Values) -> Values:
    """Bounds of the subject's pixels, computed in the subject's frame as the model does, and the
    distance of the true surface outside them."""
    batch = batch_of(v)
    masks = v["masks"]
    frame = Frame.of(batch)
    bounds = _HULL(frame.enter(batch))
    metre = frame.metre.to(v["truth"])[:, None, None, None]
    bounds = DepthBounds(bounds.near * metre, bounds.far * metre)
    outside = torch.relu(bounds.near - v["truth"]) + torch.relu(v["truth"] - bounds.far)
    seen = masks & (v["truth"] > 0)
    return {
        "near": torch.where(masks, bounds.near, 0.0),
        "far": torch.where(masks, bounds.far, 0.0),
        "outside": torch.where(seen, outside, 0.0),
    }


def _cells(v: Values) -> Tensor:
    """Condition number by which bounds, decisions on a grid,
    may differ by one cell of 1/20 of the depth."""
    return torch.full((len(v["images"]),), 0.05 / (100 * torch.finfo(torch.float32).eps))


def _frame(v: Values) -> Values:
    batch = batch_of(v)
    frame = Frame.of(batch)
    element = torch.arange(len(v["points"]))[:, None]
    world = to_world(v["points"], element, frame.in_world(v["points"].dtype))
    return {"extrinsics": frame.enter(batch).cameras.extrinsics, "world": world}


def _places(v: Values) -> Tensor:
    pixels, z = project(v["points"], *inputs.matrices(v["lenses"], v["poses"]))
    return torch.where(z[..., None] > 0, pixels, 1e9)


def _sample(v: Values) -> Values:
    image = torch.arange(len(v["maps"]))[:, None].expand(v["points"].shape[:2])
    return {"values": sample(v["maps"], image, _places(v))}


def _sample_slowly(v: Values) -> Values:
    places = _places(v).clamp(-2, _SIZE + 2)
    centers = torch.arange(_SIZE) + 0.5
    across, down = (torch.relu(1 - (places[..., axis, None] - centers).abs()) for axis in (0, 1))
    return {"values": torch.einsum("nph,npw,nchw->npc", down, across, v["maps"])}


def _photo_inputs(family: str, g: Generator) -> Values:
    values = scene(family, g, 3, _SIZE)
    return {**values, "near": values["truth"] - 0.2, "far": values["truth"] + 0.2}


def _photo(v: Values) -> Values:
    """Disagreement, whose error relates to 1 however small the agreement is."""
    return {"disagreement": 1 - photo_consistency(batch_of(v), DepthBounds(v["near"], v["far"]), 3)}


def _tokens_inputs(family: str, g: Generator) -> Values:
    masks = inputs.spoiled(family, g, inputs.disc(_SIZE).expand(2, -1, -1))
    depth = inputs.depths(family, g, 2, _SIZE, _SIZE)
    return {"depth": depth, "far": depth + 0.3, "masks": masks}


def _tokens(v: Values) -> Values:
    maps = DepthMaps(v["depth"], v["masks"], torch.ones_like(v["depth"]))
    pixels, depth, valid = subject_tokens(maps, 4)
    bounds = relative_bounds(DepthBounds(v["depth"], v["far"]), v["masks"])
    return {
        "pixels": torch.where(valid[..., None], pixels, 0.0),
        "depth": torch.where(valid, depth, 0.0),
        "relative": relative_depth(v["depth"], v["masks"]),
        "bounds": bounds,
    }


def _padding(v: Values) -> Values:
    padding = pad_to_patches(v["masks"], 4)
    padded = padding.pad_batch(batch_of(v))
    cameras = padded.cameras
    images = padding.cut(padded.images.movedim(2, -1)).movedim(-1, 2)
    moved, _ = project(v["middle"][:, None].expand(-1, 2, -1), cameras.intrinsics, cameras.extrinsics)
    corner = torch.tensor([padding.left, padding.top])
    return {"images": images, "masks": padding.cut(padded.masks).to(images), "pixel": moved + corner}


def _padding_slowly(v: Values) -> Values:
    pixel, _ = project(v["middle"][:, None].expand(-1, 2, -1), *inputs.matrices(v["lenses"], v["poses"]))
    return {"images": v["images"], "masks": v["masks"].to(v["images"]), "pixel": pixel}


_OUTSIDE_FRAME = {"wide": "the subject is smaller than a pixel", "degenerate": "nothing is in the frame"}
_HOLDS = "a sum of a few products a coordinate; each rounds once, and the inputs' rounding is in kappa"

STAGES = (
    Stage(
        "projection", ("cameras", "points"), _project_inputs, _project, 20, _HOLDS,
        gradients=("points", "lenses", "poses"), steady=("middle",),
        silent="a point behind the camera has no pixel",
    ),
    Stage(
        "unprojection", ("cameras", "depths"), _unproject_inputs,
        lambda v: {"points": unproject(v["pixels"], v["depth"], *inputs.matrices(v["lenses"], v["poses"]))},
        20, _HOLDS, _unproject_slowly,
        gradients=("pixels", "depth", "lenses", "poses"), steady=("middle",),
        silent="an infinite focal length is a ray along the axis; the model refuses it",
    ),
    Stage(
        "rays and box", ("cameras",), _rays_inputs, _rays, 50,
        "as projection, and a division by a component of the direction", silent="NaN loses every comparison",
    ),
    Stage(
        "bounds and hull", ("cameras", "masks"), lambda family, g: scene(family, g, 4, 24), _bounds, 100,
        "decisions on a grid: one cell may differ (kappa), the true surface must be inside",
        lambda v: {**_bounds(v), "outside": torch.zeros_like(v["truth"])},
        steady=("truth", "middle", "images"), seeds=32, kappa=_cells, excluded=_OUTSIDE_FRAME,
        silent="cameras that are not finite are refused before this stage",
    ),
    Stage(
        "subject frame", ("cameras", "masks"),
        lambda family, g: {**scene(family, g, 3, _SIZE), "points": inputs.normal(g, 16, 3)}, _frame, 20,
        "all of it in float64, rounded once", gradients=("points",), steady=("truth", "middle", "images"),
        excluded=_OUTSIDE_FRAME, silent="cameras that are not finite are refused before this stage",
    ),
    Stage(
        "samples of maps", ("cameras", "points", "images"),
        lambda f, g: {**_project_inputs(f, g), "maps": inputs.images(f, g, 3, _SIZE, _SIZE)}, _sample, 20,
        "a mean of four pixels; their shares lose the digits of a pixel's place (kappa)", _sample_slowly,
        steady=("middle",), seeds=64,
        excluded={"nan inf": "its callers clean their maps"},
    ),
    Stage(
        "photo-consistency", ("cameras", "images", "masks"), _photo_inputs, _photo, 100,
        "exp of a colour difference over 0.1, of bilinear samples at a projected place",
        steady=("truth", "middle"), seeds=64, silent="agreement of what cannot be compared is 0",
    ),
    Stage(
        "token points", ("depths", "masks"), _tokens_inputs, _tokens, 50,
        "means of 16 and of 144 values", gradients=("depth", "far"),
        silent="relative depths are read inside the mask only",
    ),
    Stage(
        "padding", ("cameras", "images", "masks"), lambda family, g: scene(family, g, 2, 18), _padding, 10,
        "copies, and a principal point that moves by whole pixels", _padding_slowly,
        gradients=("images",), steady=("truth", "poses"),
    ),
)  # fmt: skip
