"""Stages of geometry, heads, recalibration, rendering, losses and metrics; all but whole models."""

import copy
import math

import torch
from torch import Generator, Tensor
from torch.nn import functional

from ghgs_lit.diagnostics.stress import families
from ghgs_lit.diagnostics.stress.families import (
    COUNTS,
    UNITS,
    Values,
    batch_of,
    cameras_of,
    matrices,
    normal,
    rig,
    scene_points,
    sphere,
    uniform,
    vary,
)
from ghgs_lit.diagnostics.stress.measure import Stage, case_by_case
from ghgs_lit.geometry import chamfer, masks, precision, projection, rotations, unprojection
from ghgs_lit.geometry.frame import Frame, to_world
from ghgs_lit.method.bounds import VisualHull, rays
from ghgs_lit.method.heads import attributes, dpt
from ghgs_lit.method.heads.depth import BOUNDED, bounded_depth
from ghgs_lit.method.recalibration import SemanticAttention
from ghgs_lit.metrics.functional import psnr, ssim
from ghgs_lit.ops import activation, neighbors
from ghgs_lit.ops.attention.cpu import attend_heads
from ghgs_lit.ops.compile import processor_features
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.rendering import render
from ghgs_lit.types import DepthBounds, DepthMaps, Gaussians, Tokens

SIZE = 16  #: Side of images in pixels
CAMERAS = ("place", "cameras")  #: Ingredients of cameras, and of points before them
SEEN = (*CAMERAS, "points", "points seen")


def _project(v: Values) -> Values:
    pixels, z = projection.project(v["points"], *matrices(v))
    camera = projection.world_to_camera(v["points"], matrices(v)[1])
    return {"camera": camera, "pixels": torch.where(z[..., None] > 0, pixels, 0.0)}


def _pixels(family: str, g: Generator) -> Values:
    scene = rig(family, g, 1, SIZE)
    return {**scene, "pixels": uniform(g, 0, SIZE, 16, 2), "depth": families.depths(family, g, 16)}


def _box(family: str, g: Generator) -> Values:
    return rig(family, g, 1, 4) | {"half": 0.7 * UNITS.get(family, 1.0) * uniform(g, 1, 1.1, 3)}


def _rays(v: Values) -> Values:
    cameras = cameras_of(v, 4)
    with precision.exact("cpu"):  # as in the stage
        bounds = rays.depths_in_box(cameras, v["middle"] - v["half"], v["middle"] + v["half"])
        return {"directions": rays.ray_directions(cameras), "near": bounds.near, "far": bounds.far}


def _bounds(v: Values) -> Values:
    """Bounds of the subject's pixels, computed in its frame as in the model; infinite where the true surface
    is outside of them."""
    batch = batch_of(v)
    frame = Frame.of(batch)
    bounds = VisualHull(dilation=0.02)(frame.enter(batch))
    metre = frame.metre.to(v["truth"])[:, None, None, None]
    near, far = bounds.near * metre, bounds.far * metre
    slack = 0.05 * v["truth"]
    is_outside = (v["truth"] < near - slack) | (v["truth"] > far + slack)
    near = torch.where(is_outside & (v["truth"] > 0), torch.inf, near)
    return {"near": torch.where(v["masks"], near, 0.0), "far": torch.where(v["masks"], far, 0.0)}


def _frame(v: Values) -> Values:
    batch = batch_of(v)
    frame = Frame.of(batch)
    element = torch.arange(len(v["points"]))[:, None]
    world = to_world(v["points"], element, frame.in_world(v["points"].dtype))
    return {"extrinsics": frame.enter(batch).cameras.extrinsics, "world": world}


def _maps(family: str, g: Generator) -> Values:
    return scene_points(family, g) | {"maps": vary("images", family, uniform(g, 0, 1, 3, SIZE, SIZE), g)}


def _sample(v: Values) -> Values:
    pixels, z = projection.project(v["points"], *matrices(v))
    image = torch.arange(len(v["maps"]))[:, None].expand(v["points"].shape[:2])
    return {"values": projection.sample(v["maps"], image, torch.where(z[..., None] > 0, pixels, 1e9))}


def _near_surface(family: str, g: Generator) -> Values:
    values = sphere(family, g, 3, SIZE)
    return {**values, "near": values["truth"] - 0.2, "far": values["truth"] + 0.2}


def _photo(v: Values) -> Values:
    """Disagreement: its error is relative to 1 also where the agreement is near 0."""
    return {"disagreement": 1 - photo_consistency(batch_of(v), DepthBounds(v["near"], v["far"]), 3)}


def _depth_maps(family: str, g: Generator) -> Values:
    offsets = torch.arange(SIZE) + 0.5 - SIZE / 2
    disc = offsets[:, None].square() + offsets.square() < (0.3 * SIZE) ** 2
    depth = families.depths(family, g, 2, SIZE, SIZE)
    return {"depth": depth, "far": depth + 0.3, "masks": vary("masks", family, disc.expand(2, -1, -1), g)}


def _tokens(v: Values) -> Values:
    maps = DepthMaps(v["depth"], v["masks"], torch.ones_like(v["depth"]))
    pixels, depth, valid = unprojection.subject_tokens(maps, 4)
    return {"pixels": torch.where(valid[..., None], pixels, 0.0), "depth": torch.where(valid, depth, 0.0)}


def _relative(v: Values) -> Values:
    bounds = masks.relative_bounds(DepthBounds(v["depth"], v["far"]), v["masks"])
    return {"relative": masks.relative_depth(v["depth"], v["masks"]), "bounds": bounds}


def _raw_depths(family: str, g: Generator) -> Values:
    metre = UNITS.get(family, 1.0)
    near = metre * uniform(g, 1.5, 2.5, 24)
    raw = {name: vary("raw values", family, normal(g, 24), g) for name in ("raw", "confidence")}
    return {**raw, "near": near, "far": near + metre * uniform(g, 0.02, 1, 24)}


def _depth(v: Values) -> Values:
    depths = {name: bounded_depth(v["raw"], v["near"], v["far"], name) for name in BOUNDED}
    return {**depths, "confidence": activation.confidence_of(v["confidence"])}


_RAW = {"offset": (16, 3), "scale": (16, 3), "rotation": (16, 4), "opacity": (16,)}


def _raw_attributes(family: str, g: Generator) -> Values:
    raw = {name: vary("raw values", family, normal(g, *shape), g) for name, shape in _RAW.items()}
    return {**raw, "footprint": families.depths(family, g, 16) / 500}


def _attributes(v: Values) -> Values:
    raw = (v[name].flatten(0, 1) for name in (*_RAW, "footprint"))
    rows = activation.footprint_attributes(
        *raw, attributes.FootprintAttributes().constants(attributes.OFFSET_UNIT, 0.0)
    )
    return {name: value.unflatten(0, v["opacity"].shape) for name, value in zip(_RAW, rows, strict=True)}


def _vectors(family: str, g: Generator) -> Values:
    return {"vectors": vary("quaternions", family, normal(g, 16, 4), g)}


def _splat_axes(family: str, g: Generator) -> Values:
    scales = vary("scales", family, 0.05 * uniform(g, 0.2, 1, 16, 3), g)
    return {"quaternions": _vectors(family, g)["vectors"], "scales": scales}


def _covariance(v: Values) -> Values:
    rotation = rotations.quaternion_to_matrix(v["quaternions"])
    root = rotation * v["scales"][..., None, :]
    return {"rotation": rotation, "covariance": (root[..., :, None, :] * root[..., None, :, :]).sum(-1)}


_GRID = (2, 3)
_LAYERS = tuple(f"layer{i}" for i in range(4))

with torch.random.fork_rng(devices=[]):
    torch.manual_seed(5)
    _HEAD = dpt.DPTHead(32, 3, widths=(8, (4, 8, 8, 8))).requires_grad_(False)
HEADS = {torch.float32: _HEAD, torch.float64: copy.deepcopy(_HEAD).double()}


def _features(family: str, g: Generator) -> Values:
    return {name: vary("features", family, normal(g, math.prod(_GRID), 32), g) for name in _LAYERS}


def _dpt(v: Values) -> Values:
    shape = (len(v["layer0"]), 1, *_GRID)
    image, _, row, column = torch.ones(shape).nonzero().unbind(1)
    layers = tuple(v[name].flatten(0, 1) for name in _LAYERS)
    return {"maps": HEADS[layers[0].dtype](Tokens(layers, layers[0], image, row, column, shape, 4))}


_K = 6  #: Neighbours of a token


def _cloud(family: str, g: Generator) -> Values:
    values = scene_points(family, g)
    surface = values["middle"] + 0.3 * UNITS.get(family, 1.0) * normal(g, 20, 3)
    view = torch.randint(3, (len(values["points"]),), generator=g)
    return {"points": values["points"], "surface": surface, "view": view}


def _distances(v: Values) -> Values:
    near = neighbors.nearest_neighbors(v["points"], v["view"], _K)
    points = v["points"].double()
    return {"all": (points[near] - points[:, None]).norm(dim=-1)}


def _ties(v: Values) -> Tensor:
    """The largest number where several points coincide, so that any of them may be the nearest."""
    apart = (v["points"][:, :, None] - v["points"][:, None]).abs().sum(-1)
    is_tied = (apart == 0).flatten(1).sum(1) > apart.shape[1]
    return is_tied * torch.tensor(torch.finfo(torch.float64).max, dtype=torch.float64)


def _neighbor_table(family: str, g: Generator) -> Tensor:
    """Indices [count, k] of the neighbours of each token, all different."""
    count = COUNTS.get(family, 12)
    return torch.stack([torch.randperm(count, generator=g)[:_K] for _ in range(count)])


def _token_features(family: str, g: Generator) -> Values:
    index = _neighbor_table(family, g)
    return {"features": vary("features", family, normal(g, len(index), 16), g), "index": index}


def _qkv(family: str, g: Generator, *shape: int) -> Values:
    """Queries, keys and values."""
    return {n: vary("queries", family, vary("features", family, normal(g, *shape), g), g) for n in "qkv"}


def _queries(family: str, g: Generator) -> Values:
    index = _neighbor_table(family, g)
    cosines = uniform(g, -1, 1, *index.shape)
    return {"cosines": cosines, "index": index, **_qkv(family, g, len(index), 32)}


BLOCKS = {s: SemanticAttention(128, 2, s) for s in ("product", "product_clamped", "log")}


def _attention(v: Values) -> Values:
    """Eq. 3 with each way to use the similarity."""
    inputs = [v[name] for name in ("q", "k", "v", "index")]
    return {
        name: neighbors.attend_to_neighbors(*inputs, block.num_heads, *block.factor_and_bias(v["cosines"]))
        for name, block in BLOCKS.items()
    }


def _products(v: Values) -> Tensor:
    """Size of the products of a value and a query or key: the gradient of a softmax subtracts their mean."""
    q, k, value = (v[name].abs().flatten(1).amax(1) for name in ("q", "k", "v"))
    return torch.maximum(q, k) * value


def _heads(family: str, g: Generator) -> Values:
    return {name: value.repeat(2, 1, 1) for name, value in _qkv(family, g, 20, 64).items()}


def _attend(v: Values) -> Values:
    inputs = (v["q"], v["k"], v["v"])
    if v["q"].dtype == torch.float64:
        return {"attended": functional.scaled_dot_product_attention(*inputs).transpose(1, 2)}
    return {"attended": attend_heads(*inputs)}


def gaussians_of(v: Values) -> Gaussians:
    """Gaussians of stacked cases."""
    names = ("means", "quaternions", "scales", "opacities", "colors")
    n, count = v["opacities"].shape
    return Gaussians(*(v[name].flatten(0, 1) for name in names), splits=(count,) * n)


def backend_of(values: Tensor) -> str:
    """Renderer for a dtype: plain PyTorch in float64, kernels in float32."""
    return "reference" if values.dtype == torch.float64 else "cpu"


def _splats(family: str, g: Generator) -> Values:
    count = 1500 if family == "stacked" else 24
    scene = rig(family, g, 1, SIZE)
    means = families.points(family, g, count, scene)
    share = 1.0
    if family == "stacked":
        axis = scene["poses"][0, 2, :3]
        means = scene["middle"] + axis * uniform(g, -0.5, 0.5, count, 1) + 0.01 * normal(g, count, 3)
        share = 0.02
    return {
        "means": means,
        "quaternions": vary("quaternions", family, normal(g, count, 4), g),
        "scales": vary("scales", family, 0.3 * UNITS.get(family, 1.0) * uniform(g, 0.2, 1, count, 3), g),
        "opacities": share * vary("opacities", family, uniform(g, 0.05, 0.98, count), g),
        "colors": uniform(g, 0, 1, count, 3),
        "lenses": scene["lenses"],
        "poses": scene["poses"],
    }


def _render(v: Values) -> Values:
    rendering = render(gaussians_of(v), cameras_of(v, SIZE), backend_of(v["means"]), near=1e-6)
    return {"image": rendering.image, "alpha": rendering.alpha}


def _pair(family: str, g: Generator) -> Values:
    image, target = (vary("images", family, uniform(g, 0, 1, 3, SIZE, SIZE), g) for _ in range(2))
    return {"image": image, "target": image.clone() if family == "identical" else target}


def _brightest(v: Values) -> Tensor:
    return torch.cat((v["image"], v["target"]), 1).flatten(1).abs().amax(1)


def _losses(v: Values) -> Values:
    return {"l1": (v["image"] - v["target"]).abs().flatten(1).mean(1), "ssim": ssim(v["image"], v["target"])}


def _metrics(v: Values) -> Values:
    return {"psnr": psnr(v["image"], v["target"])}


_BOUNDED = "a value between bounds is finite whatever the raw value"
_INFINITE = "an infinite logit is a weight of 1"
_OUTSIDE_FRAME = ("wide", "degenerate")  # the subject is smaller than a pixel, or nowhere in the frame
_HOLDS = "a sum of a few products a coordinate; each rounds once, and the inputs' rounding is in kappa"
_REFUSED = "cameras that are not finite are refused before this stage"

STAGES = [
    Stage(
        "projection", SEEN, scene_points, _project, 20, _HOLDS,
        gradients=("points", "lenses", "poses"), steady=("middle",),
        silent="a point behind the camera has no pixel",
    ),
    Stage(
        "unprojection", (*CAMERAS, "depths"), _pixels,
        lambda v: {"points": projection.unproject(v["pixels"], v["depth"], *matrices(v))}, 20, _HOLDS,
        gradients=("pixels", "depth", "lenses", "poses"), steady=("middle",),
        silent="an infinite focal length is a ray along the axis; the model refuses it",
    ),
    Stage(
        "rays and box", CAMERAS, _box, _rays, 50,
        "as projection, and a division by a component of the direction", silent="NaN loses every comparison",
    ),
    Stage(
        "bounds and hull", (*CAMERAS, "masks"), lambda family, g: sphere(family, g, 4, 24), _bounds, 100,
        "decisions on a grid: one cell of 1/20 of the depth may differ (kappa)",
        kappa=lambda v: torch.tensor([0.05 / (100 * torch.finfo(torch.float32).eps)]),
        steady=("truth", "middle", "images"), seeds=32, without=_OUTSIDE_FRAME, silent=_REFUSED,
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
    Stage(
        "depth activation", ("raw values", "place"), _raw_depths, _depth, 50, "a sigmoid and two divisions",
        gradients=("raw", "near", "far"), silent=_BOUNDED,
    ),
    Stage(
        "attributes", ("raw values", "depths"), _raw_attributes, _attributes, 50,
        "an exponential of a sigmoid whose exponent is at most 3.3", gradients=(*_RAW, "footprint"),
        without=("negative_depth",),  # footprints are of points before the camera
        silent=_BOUNDED,
    ),
    Stage(
        "unit vectors", ("quaternions",), _vectors, lambda v: {"unit": rotations.unit(v["vectors"])}, 20,
        "one square root and one division", gradients=("vectors",),
    ),
    Stage(
        "quaternion and covariance", ("quaternions", "scales"), _splat_axes, _covariance, 50,
        "products of four factors, sums of three", gradients=("quaternions", "scales"),
    ),
    Stage(
        "dense head", ("features",), _features, _dpt, 100,
        "twenty convolutions in a row, each a sum of up to 72 products; tokens are normalised first",
        gradients=_LAYERS, seeds=64, is_network=True,
    ),
    Stage(
        "neighbours", ("place", "points", "neighbors"), _cloud, case_by_case(_distances), 20,
        "distances of differences: three squares and a root", steady=("surface",), seeds=48,
        silent="a point that is not finite is nobody's neighbour while there are others",
    ),
    Stage(
        "cosine", ("features", "neighbors"), _token_features,
        case_by_case(lambda v: {"cosines": neighbors.neighbor_cosines(v["features"], v["index"])}), 20,
        "a product of two unit vectors of 16 components",
    ),
    Stage(
        "attention", ("features", "queries", "neighbors"), _queries, case_by_case(_attention), 50,
        "logits of sums of 16 products, whose error the softmax multiplies by their size",
        gradients=("q", "k", "v"), seeds=48, sizes=_products, without=("huge_features",),
        silent=f"{_INFINITE}, and a token that nobody attends to has no effect",
    ),
    Stage(
        "compositing", (*SEEN, "quaternions", "scales", "opacities", "stacks"), _splats, _render, 100,
        "an exponential of a square, and a product of up to 1500 transmittances",
        gradients=("means", "quaternions", "scales", "opacities", "colors"), seeds=24,
        silent="a splat that is not finite is not drawn; the report of ghgs predict counts it",
    ),
    Stage(
        "L1 and SSIM", ("images",), _pair, _losses, 20,
        "five blurs of 121 products; the subtraction of moments is in kappa",
        gradients=("image",), seeds=96,
        # SSIM subtracts moments of size x^2 and compares the rest with 0.03^2.
        kappa=lambda v: _brightest(v).square() / 9e-4,
        # Its gradients subtract terms of 2 x / 0.03^2, each a mean over the windows.
        sizes=lambda v: 2 * _brightest(v) / (9e-4 * 3 * (SIZE - 10) ** 2),
    ),
    Stage(
        "Chamfer", ("place", "points", "neighbors"), _cloud,
        case_by_case(lambda v: {"chamfer": chamfer.chamfer(v["points"], v["surface"])}), 20,
        "means of squares of differences", gradients=("points", "surface"), seeds=96, sizes=_ties,
    ),
    Stage(
        "PSNR", ("images",), _pair, _metrics, 100, "a mean of squared differences, and its logarithm",
    ),
]  # fmt: skip
if "avx512f" in processor_features():
    STAGES.append(Stage(
        "encoder kernel", ("features", "queries"), _heads, _attend, 100,
        "logits of sums of 64 products; exponentials by a polynomial", without=("huge_features",),
        silent=_INFINITE,
    ))  # fmt: skip
