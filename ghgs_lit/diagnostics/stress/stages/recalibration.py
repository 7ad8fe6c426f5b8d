"""Stages of recalibration: neighbours, cosines and attention;
and the encoder's compiled attention."""

import torch
from torch import Generator, Tensor

from ghgs_lit.diagnostics.stress import inputs
from ghgs_lit.diagnostics.stress.stage import Stage, Values, case_by_case
from ghgs_lit.method.recalibration import SemanticAttention
from ghgs_lit.ops.attention.cpu import attend_heads
from ghgs_lit.ops.compile import processor_features
from ghgs_lit.ops.neighbors import attend_to_neighbors, nearest_neighbors, neighbor_cosines

_K = 6
_COUNT = {"few": 4, "single": 1}


def _point_inputs(family: str, g: Generator) -> Values:
    count = _COUNT.get(family, 20)
    middle = inputs.place(family, g)
    view = torch.randint(3, (count,), generator=g)
    return {"points": inputs.points(family, g, count, middle), "view": view}


def _distances(v: Values) -> Values:
    exact = v["points"].double()
    near = nearest_neighbors(v["points"], v["view"], _K)
    return {"all": (exact[near] - exact[:, None]).norm(dim=-1)}


def _distances_slowly(v: Values) -> Values:
    distance = (v["points"][:, None] - v["points"]).norm(dim=-1)
    return {"all": distance.sort(-1).values[:, :_K]}


def _neighbor_table(g: Generator, count: int, k: int) -> Tensor:
    """Indices [count, k] of ``k`` different tokens for each of ``count``."""
    return torch.stack([torch.randperm(count, generator=g)[:k] for _ in range(count)])


def _cosine_inputs(family: str, g: Generator) -> Values:
    count = _COUNT.get(family, 12)
    features = inputs.features(family, g, count, 16)
    return {"features": features, "index": _neighbor_table(g, count, min(_K, count))}


def _cosines_slowly(v: Values) -> Values:
    largest = v["features"].abs().amax(-1, keepdim=True)
    scaled = v["features"] / torch.where(largest > 0, largest, 1.0)
    length = scaled.norm(dim=-1, keepdim=True)
    unit = scaled / torch.where(length > 0, length, 1.0)
    return {"cosines": (unit[:, None] * unit[v["index"]]).sum(-1)}


def _attention_features(family: str, g: Generator, *shape: int) -> Tensor:
    """Features of a family, of which huge ones are 30 times as large as ordinary ones."""
    if family == "huge_features":
        return 30.0 * inputs.normal(g, *shape)
    return inputs.features(family, g, *shape)


def _attention_inputs(family: str, g: Generator) -> Values:
    count = _COUNT.get(family, 12)
    k = min(_K, count)
    features = {name: _attention_features(family, g, count, 32) for name in ("q", "k", "v")}
    cosines = inputs.uniform(g, -1, 1, count, k)
    return {**features, "cosines": cosines, "index": _neighbor_table(g, count, k)}


_BLOCKS = {s: SemanticAttention(128, 2, s) for s in ("product", "product_clamped", "log")}


def _attention(v: Values) -> Values:
    """Eq. 3 with every use of the similarity."""
    inputs = [v[name] for name in ("q", "k", "v", "index")]
    results = {}
    for name, block in _BLOCKS.items():
        results[name] = attend_to_neighbors(*inputs, block.num_heads, *block.factor_and_bias(v["cosines"]))
    return results


def _attention_slowly(v: Values) -> Values:
    q, k, value = (v[name].unflatten(-1, (2, 16)) for name in ("q", "k", "v"))
    s = v["cosines"]
    logits = torch.einsum("mad,mkad->amk", q, k[v["index"]]) / 4.0
    changed = {
        "product": logits * s,
        "product_clamped": logits * s.clamp(min=0),
        "log": logits + s.clamp(min=0.01).log(),
    }
    weights = {name: x.softmax(-1) for name, x in changed.items()}
    rows = value[v["index"]]
    return {name: torch.einsum("amk,mkad->mad", w, rows).flatten(1) for name, w in weights.items()}


def _products(v: Values) -> Tensor:
    """Size of the products of a value and a query or key,
    whose mean a softmax's gradient subtracts."""
    q, k, value = (v[name].abs().flatten(1).amax(1) for name in ("q", "k", "v"))
    return torch.maximum(q, k) * value


def _head_inputs(family: str, g: Generator) -> Values:
    """Queries, keys and values of two heads, which are equal except for huge features."""
    shape = (2, 20, 64) if family == "huge_features" else (20, 64)
    features = {name: _attention_features(family, g, *shape) for name in ("q", "k", "v")}
    return {name: value.expand(2, 20, 64).clone() for name, value in features.items()}


def _heads_slowly(v: Values) -> Values:
    weights = (v["q"] @ v["k"].mT / 8).softmax(-1)
    return {"attended": (weights @ v["v"]).transpose(1, 2)}


_HUGE = "queries and keys 30 times as large as ordinary ones: they follow a LayerNorm"
_INFINITE = "an infinite logit is a weight of 1"

STAGES = [
    Stage(
        "neighbours", ("cameras", "points", "neighbors"), _point_inputs, case_by_case(_distances), 20,
        "distances of differences: three squares and a root", case_by_case(_distances_slowly), seeds=48,
        excluded=inputs.NO_CAMERA,
        silent="a point that is not finite is nobody's neighbour while there are others",
    ),
    Stage(
        "cosine", ("features", "neighbors"), _cosine_inputs, case_by_case(
            lambda v: {"cosines": neighbor_cosines(v["features"], v["index"])}
        ), 20,
        "a product of two unit vectors of 16 components", case_by_case(_cosines_slowly),
    ),
    Stage(
        "attention", ("features", "neighbors"), _attention_inputs, case_by_case(_attention), 50,
        f"logits of sums of 16 products, whose error the softmax multiplies by their size. {_HUGE}",
        case_by_case(_attention_slowly), gradients=("q", "k", "v"), seeds=48, sizes=_products,
        silent=f"{_INFINITE}, and a token that nobody attends to has no effect",
    ),
]  # fmt: skip
if "avx512f" in processor_features():
    STAGES.append(Stage(
        "encoder kernel", ("features",), _head_inputs,
        lambda v: {"attended": attend_heads(v["q"], v["k"], v["v"])}, 100,
        f"logits of sums of 64 products; exponentials by a polynomial. {_HUGE}", _heads_slowly,
        kind="kernel", silent=_INFINITE,
    ))  # fmt: skip
