"""Neighbours, cosines and attention among them, and their compiled kernels."""

import torch
from torch import Generator, Tensor

from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import Stage, Values
from ghgs_lit.encoder.cpu.attention import attend as attend_heads
from ghgs_lit.kernels.compile import processor_features
from ghgs_lit.recalibration import SemanticAttention, nearest_neighbors
from ghgs_lit.recalibration.neighbors import Neighbors
from ghgs_lit.recalibration.recalibration import neighbor_cosines

_K = 6
_COUNT = {"few": 4, "single": 1}


def _point_inputs(family: str, g: Generator) -> Values:
    count = _COUNT.get(family, 20)
    middle = inputs.place(family, g)
    view = torch.randint(3, (count,), generator=g)
    if family == "masked":
        view = torch.zeros_like(view)
    return {"points": inputs.points(family, g, count, middle), "view": view}


def _distances(v: Values) -> Values:
    """Distances, in float64, of the neighbours that are found."""
    each = []
    for points, view in zip(v["points"], v["view"], strict=True):
        near, exact = nearest_neighbors(points, view, _K), points.double()
        each.append((exact[near.index] - exact[:, None]).norm(dim=-1))
    return {"all": torch.stack(each)}


def _distances_slowly(v: Values) -> Values:
    """Every difference, sorted."""
    distance = (v["points"][:, :, None] - v["points"][:, None]).norm(dim=-1)
    return {"all": distance.sort(-1).values[..., :_K]}


def _neighbor_table(family: str, g: Generator, count: int, k: int) -> Values:
    index = torch.stack([torch.randperm(count, generator=g)[:k] for _ in range(count)])
    valid = torch.ones_like(index, dtype=torch.bool)
    if family == "masked":
        valid[:, 1:] = False
    return {"index": index, "valid": valid}


def _cosine_inputs(family: str, g: Generator) -> Values:
    count = _COUNT.get(family, 12)
    return {
        "features": inputs.features(family, g, count, 16),
        **_neighbor_table("", g, count, min(_K, count)),
    }


def _cosines(v: Values) -> Values:
    pairs = zip(v["features"], v["index"], v["valid"], strict=True)
    return {"cosines": torch.stack([neighbor_cosines(f, Neighbors(i, m)) for f, i, m in pairs])}


def _cosines_slowly(v: Values) -> Values:
    """Angles of scaled features."""
    features = v["features"]
    largest = features.abs().amax(-1, keepdim=True)
    features = features / torch.where(largest > 0, largest, 1.0)
    length = features.norm(dim=-1, keepdim=True)
    features = features / torch.where(length > 0, length, 1.0)
    return {
        "cosines": torch.stack(
            [(f[:, None] * f[i]).sum(-1) for f, i in zip(features, v["index"], strict=True)]
        )
    }


def _attention_inputs(family: str, g: Generator) -> Values:
    count = _COUNT.get(family, 12)
    k = min(_K, count)
    large = {"huge_features": 30.0}.get(family)
    q, k_, v = (
        large * inputs.normal(g, count, 32) if large else inputs.features(family, g, count, 32)
        for _ in range(3)
    )
    cosines = inputs.uniform(g, -1, 1, count, k)
    return {"q": q, "k": k_, "v": v, "cosines": cosines, **_neighbor_table(family, g, count, k)}


_BLOCKS = {s: SemanticAttention(128, 2, s) for s in ("product", "product_clamped", "log")}


def _attention(v: Values) -> Values:
    """Eq. 3 with every use of the similarity."""
    found = {}
    for name, block in _BLOCKS.items():
        each = [
            block._attend(q, k, value, Neighbors(index, valid), cosines)
            for q, k, value, index, valid, cosines in zip(
                *(v[name] for name in ("q", "k", "v", "index", "valid", "cosines")), strict=True
            )
        ]
        found[name] = torch.stack(each)
    return found


def _attention_slowly(v: Values) -> Values:
    """Gathered, one softmax a head."""
    found = {}
    for name in _BLOCKS:
        each = []
        for q, k, value, index, valid, s in zip(
            *(v[name] for name in ("q", "k", "v", "index", "valid", "cosines")), strict=True
        ):
            q, k, value = (x.unflatten(-1, (2, 16)) for x in (q, k, value))
            logits = torch.einsum("mad,mkad->amk", q, k[index]) / 4.0
            if name == "log":
                logits = logits + s.clamp(min=0.01).log()
            else:
                logits = logits * (s.clamp(min=0) if name == "product_clamped" else s)
            weights = logits.masked_fill(~valid, -torch.inf).softmax(-1)
            each.append(torch.einsum("amk,mkad->mad", weights, value[index]).flatten(1))
        found[name] = torch.stack(each)
    return found


def _products(v: Values) -> Tensor:
    """The gradient of a softmax subtracts products of a value and a query or key from their mean."""
    q, k, value = (v[name].abs().flatten(1).amax(1) for name in ("q", "k", "v"))
    return torch.maximum(q, k) * value


def _head_inputs(family: str, g: Generator) -> Values:
    large = 30.0 if family == "huge_features" else None
    names = ("q", "k", "v")
    return {
        name: large * inputs.normal(g, 2, 20, 64)
        if large
        else torch.stack([inputs.features(family, g, 20, 64)] * 2)
        for name in names
    }


def _head_kernel(v: Values) -> Values:
    return {"attended": attend_heads(v["q"], v["k"], v["v"])}


def _heads_slowly(v: Values) -> Values:
    weights = (v["q"] @ v["k"].mT / 8).softmax(-1)
    return {"attended": (weights @ v["v"]).transpose(1, 2)}


_FLOAT32 = ("float32", "bfloat16", "float16")
_KERNEL = "the kernel takes float32"
_HUGE = "queries and keys 30 times as large as ordinary ones: they follow a LayerNorm"

STAGES = (
    Stage(
        "neighbours", ("cameras", "points", "neighbors"), _point_inputs, _distances, 20,
        "distances of differences: three squares and a root", _distances_slowly, seeds=48,
        excluded={
            **{n: "takes points, no camera" for n in ("wide", "long", "skewed", "mirrored", "degenerate")},
            **{n: "relative to a camera" for n in ("behind", "on_camera", "beside")},
        },
        silent="a point that is not finite is nobody's neighbour while there are others",
    ),
    Stage(
        "cosine", ("features", "neighbors"), _cosine_inputs, _cosines, 20,
        "a product of two unit vectors of 16 components", _cosines_slowly,
    ),
    Stage(
        "attention", ("features", "neighbors"), _attention_inputs, _attention, 50,
        f"logits of sums of 16 products, whose error the softmax multiplies by their size. {_HUGE}",
        _attention_slowly, gradients=("q", "k", "v"), seeds=48, sizes=_products,
        silent="an infinite logit is a weight of 1, and a token that nobody attends to has no effect",
    ),
    *((Stage(
        "encoder kernel", ("features",), _head_inputs, _head_kernel, 100,
        f"logits of sums of 64 products; exponentials by a polynomial. {_HUGE}", _heads_slowly,
        dtypes=_FLOAT32, no_dtype=_KERNEL, silent="an infinite logit is a weight of 1",
    ),) if "avx512f" in processor_features() else ()),
)  # fmt: skip
