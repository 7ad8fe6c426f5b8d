"""Stages of heads: dense heads, activations of depth and attributes,
quaternions and covariances."""

import copy

import torch
from torch import Generator

from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import Stage, Values
from ghgs_lit.geometry.rotations import quaternion_to_matrix, unit
from ghgs_lit.method.heads.attributes import FootprintAttributes
from ghgs_lit.method.heads.depth import BOUNDED, bounded_depth
from ghgs_lit.method.heads.dpt import DPTHead
from ghgs_lit.ops.activation import confidence_of
from ghgs_lit.types import Tokens


def _depth_inputs(family: str, g: Generator) -> Values:
    near = inputs.depths("equal_depths" if family == "equal_depths" else "ordinary", g, 24)
    metre = inputs.UNITS.get(family, 1.0)
    raw = inputs.raw(family, g, 24)
    far = near * metre + inputs.uniform(g, 0.02, 1, 24) * metre
    return {"raw": raw, "near": near * metre, "far": far, "confidence": inputs.raw(family, g, 24)}


def _depth(v: Values) -> Values:
    depths = {name: bounded_depth(v["raw"], v["near"], v["far"], name) for name in BOUNDED}
    return {**depths, "confidence": confidence_of(v["confidence"])}


def _attribute_inputs(family: str, g: Generator) -> Values:
    sizes = {"offset": (3,), "scale": (3,), "rotation": (4,), "opacity": ()}
    raw = {name: inputs.raw(family, g, 16, *size) for name, size in sizes.items()}
    return {**raw, "footprint": inputs.depths(family, g, 16) / 500}


_ATTRIBUTES = FootprintAttributes()


def _attributes(v: Values) -> Values:
    names = ("offset", "scale", "rotation", "opacity", "footprint")
    rows = _ATTRIBUTES(*(v[name].flatten(0, 1) for name in names))
    rows = dict(zip(("offsets", "scales", "quaternions", "opacities"), rows, strict=True))
    return {name: value.unflatten(0, v["opacity"].shape) for name, value in rows.items()}


def _covariance(v: Values) -> Values:
    rotation = quaternion_to_matrix(v["quaternions"])
    root = rotation * v["scales"][..., None, :]
    return {"rotation": rotation, "covariance": (root[..., :, None, :] * root[..., None, :, :]).sum(-1)}


def _covariance_slowly(v: Values) -> Values:
    """Rotation and covariance by quaternion products with the axes, q e conj(q)."""
    q = v["quaternions"]
    length = q.norm(dim=-1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=q.dtype)
    q = torch.where(length > 0, q / torch.where(length > 0, length, 1.0), identity)
    real = q[..., None, :1]
    imaginary = q[..., None, 1:].expand(*q.shape[:-1], 3, 3)
    axes = torch.eye(3, dtype=q.dtype).expand_as(imaginary)
    twice = 2 * torch.linalg.cross(imaginary, axes)
    rotation = (axes + real * twice + torch.linalg.cross(imaginary, twice)).mT
    squares = torch.diag_embed(v["scales"].square())
    return {"rotation": rotation, "covariance": rotation @ squares @ rotation.mT}


_GRID = (2, 3)


def _head() -> DPTHead:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        return DPTHead(32, 3, widths=(8, (4, 8, 8, 8))).requires_grad_(False)


_HEADS = {torch.float32: _head()}
_HEADS[torch.float64] = copy.deepcopy(_HEADS[torch.float32]).double()


def _dpt(v: Values) -> Values:
    shape = (len(v["layer0"]), 1, *_GRID)
    image, _, row, column = torch.ones(shape).nonzero().unbind(1)
    layers = tuple(v[f"layer{i}"].flatten(0, 1) for i in range(4))
    return {"maps": _HEADS[layers[0].dtype](Tokens(layers, layers[0], image, row, column, shape, 4))}


_BOUNDED = "a value between bounds is finite whatever the raw value"

STAGES = (
    Stage(
        "depth activation", ("raw values", "cameras", "depths"), _depth_inputs, _depth, 50,
        "a sigmoid and two divisions", gradients=("raw", "near", "far"), silent=_BOUNDED,
        excluded={
            "zero_depth negative_depth near_zero_depth huge_depth": "depths are the result",
            "shifted wide long skewed mirrored degenerate": "takes bounds, not cameras",
        },
    ),
    Stage(
        "attributes", ("raw values", "depths"), _attribute_inputs, _attributes, 50,
        "an exponential of a sigmoid whose exponent is at most 3.3",
        gradients=("offset", "scale", "rotation", "opacity", "footprint"), silent=_BOUNDED,
        excluded={"negative_depth": "footprints are of points before the camera"},
    ),
    Stage(
        "unit vectors", ("quaternions",), lambda family, g: {"vectors": inputs.quaternions(family, g, 16)},
        lambda v: {"unit": unit(v["vectors"])}, 20,
        "one square root and one division", gradients=("vectors",),
    ),
    Stage(
        "quaternion and covariance", ("quaternions", "scales"),
        lambda f, g: {"quaternions": inputs.quaternions(f, g, 16), "scales": inputs.scales(f, g, 16)},
        _covariance, 50, "products of four factors, sums of three", _covariance_slowly,
        gradients=("quaternions", "scales"),
    ),
    Stage(
        "dense head", ("features",),
        lambda f, g: {f"layer{i}": inputs.features(f, g, _GRID[0] * _GRID[1], 32) for i in range(4)},
        _dpt, 100,
        "twenty convolutions in a row, each a sum of up to 72 products; tokens are normalised first",
        gradients=tuple(f"layer{i}" for i in range(4)), seeds=64, kind="network",
    ),
)  # fmt: skip
