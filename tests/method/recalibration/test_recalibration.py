"""The recalibration stage: attention against the equations and the release, and its options."""

import dataclasses
from typing import get_args

import pytest
import torch

from ghgs_lit.method.recalibration import Neighborhood, SemanticAttention
from ghgs_lit.method.recalibration.inspection import collect_calls, shared_neighbors
from ghgs_lit.method.recalibration.recalibration import (
    RecalibrationOptions,
    Similarity,
    neighbor_count,
)
from ghgs_lit.ops.neighbors import attend_to_neighbors, nearest_neighbors, neighbor_cosines
from tests.helpers.scenes import CASES, fixture
from tests.helpers.tokens import literal_attention, make_stage, scene

SIMILARITIES = get_args(Similarity)
FIXTURES = ["sc3d_n200", "sc3d_b2_n150", "sc3d_small_variance"]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", FIXTURES)
def test_attention_matches_the_release(name, dtype):
    """Neighbours, cosines and output reproduce the authors' numbers."""
    options = CASES[name]["constructor"]
    block = SemanticAttention(options["dim"], options["num_heads"], "product_clamped").to(dtype)
    block.load_state_dict(fixture(name, "state", dtype))
    inputs, expected = fixture(name, "in", dtype), fixture(name, "out64", torch.float64)
    neighbors = [
        nearest_neighbors(p, torch.zeros(len(p), dtype=torch.int64), options["k"]) for p in inputs["pos3d"]
    ]
    found = torch.stack([element.sort(1).values for element in neighbors])
    assert torch.equal(found, fixture(name, "out")["neighbours_sorted"])
    cosines = [neighbor_cosines(*pair) for pair in zip(inputs["feat_sem"], neighbors, strict=True)]
    around = map(Neighborhood, neighbors, cosines)
    out = torch.stack([block(*element) for element in zip(inputs["feats"], around, strict=True)])
    ordered = torch.stack([c.gather(1, n.argsort(1)) for c, n in zip(cosines, neighbors, strict=True)])
    bounds = CASES[name]["bounds"] if dtype == torch.float32 else {"out": 1e-9, "cosine_sorted": 1e-9}
    torch.testing.assert_close(
        ordered.double(), expected["cosine_sorted"], atol=bounds["cosine_sorted"], rtol=0
    )
    torch.testing.assert_close(out.double(), expected["out"], atol=bounds["out"], rtol=0)


@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_recalibration_is_the_literal_equations(similarity):
    """Every option equals Eqs. 3 to 5 written as loops."""
    tokens, points = scene()
    module = make_stage(similarity=similarity).double()
    tokens = dataclasses.replace(tokens, latent=tuple(t.double() for t in tokens.latent))
    found = module(tokens, points)
    for layer, before in zip(found.latent, tokens.latent, strict=True):
        expected = before.clone()
        for b in range(2):
            at = (points.tokens_valid & (tokens.image // 3 == b)).nonzero()[:, 0]
            expected[at] = literal_attention(
                module.block,
                before[at],
                points.tokens[at],
                tokens.semantic[at],
                4,
            )
        torch.testing.assert_close(layer, expected, atol=1e-6, rtol=0)  # cosines are float32


def test_other_tokens_pass_unchanged_and_all_takes_them_in():
    """Tokens outside the subject change only with ``tokens=all``."""
    tokens, points = scene()
    found = make_stage()(tokens, points)
    changed = (found.latent[2] != tokens.latent[2]).any(1)
    assert torch.equal(changed, points.tokens_valid)
    every = make_stage(tokens="all")(tokens, points)
    assert (every.latent[2] != tokens.latent[2]).any(1).all()


def test_a_share_of_the_tokens_is_a_number_for_each_element():
    """A tenth of 40 and of 25 tokens, at least one; an integer is independent of the number of tokens."""
    assert [neighbor_count(0.1, count) for count in (40, 25, 3, 0)] == [4, 2, 1, 1]
    assert [neighbor_count(64, count) for count in (40, 1000)] == [64, 64]
    assert RecalibrationOptions(k=0.1).k == 0.1
    assert isinstance(RecalibrationOptions(k=3).k, int)
    tokens, points = scene()
    share, sizes = (
        make_stage(k=0.3)(tokens, points),
        [int(points.tokens_valid[tokens.image // 3 == b].sum()) for b in (0, 1)],
    )
    for element, size in enumerate(sizes):
        own = tokens.image // 3 == element
        number = make_stage(k=round(0.3 * size))(tokens, points)
        assert torch.equal(share.latent[0][own], number.latent[0][own])


def test_neighborhoods():
    """Only ``xyz`` reads the points; token centres on the image plane are the same in all views."""
    tokens, points = scene(((16, 16, 16),))
    outputs = {name: make_stage(neighborhood=name)(tokens, points) for name in ("xyz", "image_plane")}
    far = dataclasses.replace(points, tokens=points.tokens.flip(0))
    for name, before in outputs.items():
        after = make_stage(neighborhood=name)(tokens, far)
        assert torch.equal(after.latent[0], before.latent[0]) == (name != "xyz")
    position = make_stage(neighborhood="image_plane").positions(tokens, points)
    assert torch.equal(position[:16], position[16:32])
    assert position.min() == 1.0  # pixels: half a patch
    assert position.max() == 7.0


@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_gradients_are_finite_where_points_coincide(similarity):
    """Coincident points and zero features give finite gradients, and points get none."""
    tokens, points = scene()
    points = dataclasses.replace(points, tokens=torch.zeros_like(points.tokens).requires_grad_())
    tokens = dataclasses.replace(
        tokens,
        latent=tuple((1e3 * t).requires_grad_() for t in tokens.latent),
        semantic=torch.zeros_like(tokens.semantic),
    )
    module = make_stage(similarity=similarity)
    sum(t.square().mean() for t in module(tokens, points).latent).backward()
    gradients = [p.grad for p in module.parameters()] + [t.grad for t in tokens.latent]
    assert all(g.isfinite().all() for g in gradients)
    assert points.tokens.grad is None


def test_dissimilar_neighbors_lose_their_weight_in_log_only():
    """``log`` lowers the weight of a dissimilar neighbour; clamping leaves it at 1/2."""
    weights = {}
    for name in ("product_clamped", "log"):
        _, bias = make_stage(similarity=name).block.factor_and_bias(torch.tensor([1.0, -1.0]))
        weights[name] = (torch.zeros(2) + (0 if bias is None else bias)).softmax(-1)[1].item()
    assert weights["product_clamped"] == 0.5
    assert weights["log"] == pytest.approx(0.01 / 1.01)


def test_blocks_of_queries_change_nothing(monkeypatch):
    """Computing tokens in parts gives the same result."""
    tokens, points = scene()
    module = make_stage()
    expected = module(tokens, points)
    monkeypatch.setattr("ghgs_lit.method.recalibration.recalibration._ROWS", 5)
    with torch.no_grad():
        found = module(tokens, points)
    torch.testing.assert_close(found.latent[3], expected.latent[3], atol=1e-6, rtol=0)


@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_gathered_neighbors_give_what_a_product_of_all_tokens_gives(similarity, monkeypatch):
    """The path for a GPU and for many tokens, in one part and in several with recomputation in the
    backward pass."""
    torch.manual_seed(0)
    block = SemanticAttention(64, 2, similarity).double()
    inputs = [torch.randn(40, 16, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    near = nearest_neighbors(torch.rand(40, 3), torch.arange(40) % 3, 9)
    cosines = None if similarity == "none" else torch.rand(40, 9, dtype=torch.float64) * 2 - 1

    def results():
        out = attend_to_neighbors(*inputs, near, 2, *block.factor_and_bias(cosines))
        return out, *torch.autograd.grad(out.square().sum(), inputs)

    expected = results()
    monkeypatch.setattr("ghgs_lit.ops.neighbors._SCORES", 0)
    for most in (1 << 25, 9 * 16 * 7):
        monkeypatch.setattr("ghgs_lit.ops.neighbors._GATHERED", most)
        for a, b in zip(results(), expected, strict=True):
            torch.testing.assert_close(a, b)


@pytest.mark.parametrize("neighborhood", ["xyz", "image_plane"])
def test_neighbors_that_the_ablation_keeps_are_counted(neighborhood):
    """Against sets of the nearest tokens in space and on the image plane."""
    tokens, points = scene()
    with collect_calls(stage_of := make_stage(k=5, neighborhood=neighborhood)) as calls:
        stage_of(tokens, points)
    stage_of(tokens, points)  # outside the context: not collected
    (call,) = calls
    for element, share in enumerate(shared_neighbors(*call)):
        chosen = ((tokens.image // 3 == element) & points.tokens_valid).nonzero()[:, 0]
        near = nearest_neighbors(points.tokens[chosen], tokens.image[chosen], 5)
        other = make_stage(k=5, neighborhood="image_plane")
        places = other.places(tokens)[chosen]
        where, views = other.positions(tokens, points)[chosen], tokens.grid[1]
        flat = nearest_neighbors(where, tokens.image[chosen], 5, places, views)
        same = [len(set(a) & set(b)) / 5 for a, b in zip(near.tolist(), flat.tolist(), strict=True)]
        assert share == pytest.approx(sum(same) / len(same), abs=1e-6)
        assert 0.1 < share < 0.9
