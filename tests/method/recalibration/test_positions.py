"""Relative positions in the attention values (``recalibration.positions=relative``)."""

import dataclasses

import pytest
import torch
from torch.autograd import gradcheck

from ghgs_lit.geometry.frame import places_around
from ghgs_lit.method.plan import make_plan
from ghgs_lit.method.recalibration import Neighborhood, SemanticAttention
from tests.helpers.tokens import literal_attention, make_stage, scene


def relative_stage(**options):
    """A stage in float64 whose values depend on positions, as after some training."""
    stage = make_stage(positions="relative", **options).double()
    torch.nn.init.normal_(stage.block.place_proj.weight)
    return stage


def double(tokens):
    return dataclasses.replace(tokens, latent=tuple(layer.double() for layer in tokens.latent))


def at(points, places):
    return dataclasses.replace(points, tokens=places)


def test_a_neighbour_says_where_it_lies():
    """Values with positions equal loops over queries, heads and neighbours."""
    tokens, points = scene()
    tokens = double(tokens)
    points = at(points, points.tokens.double())
    stage = relative_stage(similarity="none")
    found = stage(tokens, points)
    for element in range(2):
        chosen = (points.tokens_valid & (tokens.image // 3 == element)).nonzero()[:, 0]
        expected = literal_attention(
            stage.block, tokens.latent[1][chosen], points.tokens[chosen], tokens.semantic[chosen], stage.k
        )
        torch.testing.assert_close(found.latent[1][chosen], expected, atol=1e-12, rtol=0)


def test_training_starts_as_without():
    """The map of positions is 0 initially, and learns from the first step on."""
    tokens, points = scene()
    off = make_stage()
    on = make_stage(positions="relative")
    assert on.state_dict().keys() - off.state_dict().keys() == {"block.place_proj.weight"}
    found = on(tokens, points)
    for layer, expected in zip(found.latent, off(tokens, points).latent, strict=True):
        torch.testing.assert_close(layer, expected)
    found.latent[0].square().sum().backward()
    assert (on.block.place_proj.weight.grad.abs() > 0).all()


@pytest.mark.parametrize("scores", [1 << 26, 0], ids=["product", "gathered"])
def test_the_gradient_is_that_of_finite_differences(scores, monkeypatch):
    """With respect to tokens, positions and their map."""
    monkeypatch.setattr("ghgs_lit.ops.neighbors._SCORES", scores)
    torch.manual_seed(0)
    block = SemanticAttention(16, 2, has_places=True).double()
    near = torch.stack([torch.randperm(6)[:3] for _ in range(6)])
    cosines = torch.rand(6, 3, dtype=torch.float64)
    x = torch.randn(6, 16, dtype=torch.float64, requires_grad=True)
    places = torch.randn(6, 3, dtype=torch.float64, requires_grad=True)
    weight = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)

    def attend(x, places, weight):
        arguments = (x, Neighborhood(near, cosines, None, places))
        return torch.func.functional_call(block, {"place_proj.weight": weight}, arguments)

    assert gradcheck(attend, (x, places, weight), fast_mode=True)


@pytest.mark.parametrize("options", [{}, {"k": 0.3}], ids=["number", "share"])
def test_padding_of_a_shape_bucket_has_no_effect(options):
    """Padding of a shape bucket, as on a GPU, has no effect; one point is not finite."""
    tokens, points = scene(((16, 9, 3), (6, 2, 5)))
    tokens = double(tokens)
    places = points.tokens.double()
    places[points.tokens_valid.nonzero()[20, 0]] = torch.nan
    points = at(points, places)
    stage = relative_stage(**options)
    kept = torch.ones(2, 3, 4, 4, dtype=torch.bool)
    plan = make_plan(points.valid, tokens.patch_size, kept, in_buckets=True)
    assert plan.peers.real is not None
    found, expected = stage(tokens, points, plan), stage(tokens, points)
    torch.testing.assert_close(found.latent[0], expected.latent[0], atol=1e-12, rtol=0)
    assert found.latent[0].isfinite().all()


def test_places_are_in_units_of_the_subject():
    """Background tokens, which are recalibrated with tokens=all, change neither centre nor unit."""
    points = torch.tensor([[1.0, 0.0, 0.0], [3.0, 0.0, 0.0], [50.0, 0.0, 0.0], [torch.inf, 0.0, 0.0]])
    found = places_around(points, torch.tensor([True, True, False, True]))
    assert found[:, 0].tolist() == [-1.0, 1.0, 48.0, 0.0]
    assert places_around(points[:1], torch.tensor([True])).tolist() == [[0.0, 0.0, 0.0]]
    assert places_around(points[:0], torch.tensor([], dtype=torch.bool)).shape == (0, 3)


def test_half_precision_keeps_places_exact():
    """The contribution of positions is computed in float32 under autocast."""
    tokens, points = scene()
    stage = make_stage(positions="relative")
    torch.nn.init.normal_(stage.block.place_proj.weight)
    seen = []
    stage.block.o_proj.register_forward_pre_hook(lambda layer, inputs: seen.append(inputs[0]))
    moved = stage.block._add_positions
    stage.block._add_positions = lambda *inputs: seen.append(moved(*inputs)) or seen[-1]
    with torch.autocast("cpu", torch.bfloat16):
        found = stage(tokens, points)
    assert {value.dtype for value in seen} == {torch.float32}
    assert found.latent[0].dtype == torch.float32
