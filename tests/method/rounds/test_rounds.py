"""Rounds: initial behaviour, bounds, and training."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from scipy.signal import correlate

from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.extents import extents
from ghgs_lit.losses import terms
from ghgs_lit.method.model import GHGS
from ghgs_lit.method.rounds import NoRounds
from ghgs_lit.method.rounds.exchange import Exchange, Windows
from ghgs_lit.method.rounds.rounds import REACH
from ghgs_lit.rendering import render
from tests.helpers.models import ATTRIBUTES, config, make_model, predict
from tests.helpers.scenes import make_batch

RECURRENT = ("model=recurrent", "skip=exact", "rounds.hidden=16", "rounds.depths=4")


def model(*overrides, kick=0.0, seed=0):
    found = make_model(*RECURRENT, *overrides, seed=seed).eval()
    if kick:
        torch.nn.init.normal_(found.rounds.change[-1].weight, std=kick)
        torch.nn.init.normal_(found.rounds.exchange.hear.weight, std=kick)
    return found


def test_untrained_rounds_change_nothing():
    batch, recurrent = make_batch(2, 3), model("rounds.gains=false")
    with torch.no_grad():
        found = predict(recurrent, batch)
        recurrent.rounds = NoRounds()
        expected = predict(recurrent, batch)
    assert torch.equal(found.depth, expected.depth)
    for name in ATTRIBUTES:
        assert torch.equal(getattr(found.gaussians, name), getattr(expected.gaussians, name)), name
    assert len(found.rounds) == 3
    assert torch.equal(found.depth, found.rounds[-1].depth)


@pytest.mark.parametrize(("count", "reach"), [(1, REACH), (8, REACH), (1, 1.0)])
def test_more_rounds_than_trained_stay_within_bounds(monkeypatch, count, reach):
    """For any weights and range of the search, depths stay between near and far, and everything is finite."""
    monkeypatch.setattr("ghgs_lit.method.rounds.rounds.REACH", reach)
    batch = make_batch(1, 4)
    wild = model(kick=30.0)
    wild.rounds.count = count
    with torch.no_grad():
        found = predict(wild, batch)
    assert len(found.rounds) == count + 1
    for maps in found.rounds[1:]:
        depth, bounds = maps.depth[maps.valid], maps.bounds
        slack = 1e-5 * depth
        assert (depth >= bounds.near[maps.valid] - slack).all()
        assert (depth <= bounds.far[maps.valid] + slack).all()
        assert reach < 1 or (depth > bounds.far[maps.valid] - 1e-3).any()  # some reach their bounds
    for name in ATTRIBUTES:
        assert getattr(found.gaussians, name).isfinite().all(), name
    assert (found.rounds[-1].depth != found.rounds[0].depth)[batch.masks].float().mean() > 0.9


def test_gaussians_that_are_replaced_need_no_gradient():
    """Training computes no gradients for them, and has the same total gradients as evaluation, which does."""
    batch, kicked = make_batch(1, 4), model("rounds.training_counts=[2]", kick=0.1)
    learned, found = [p for p in kicked.parameters() if p.requires_grad], []
    for is_training in (False, True):
        gaussians = predict(kicked.train(is_training), batch).gaussians
        loss = sum(getattr(gaussians, name).square().mean() for name in ATTRIBUTES)
        slopes = torch.autograd.grad(loss, learned, allow_unused=True, materialize_grads=True)
        found.append(torch.cat([slope.flatten() for slope in slopes]))
    assert found[0].norm() > 0
    assert (found[1] - found[0]).norm() < 1e-3 * found[0].norm()


def test_gradients_reach_every_weight_and_every_round_is_supervised():
    batch = make_batch(1, 3)
    kicked = model(kick=0.1).train()
    prediction = predict(kicked, batch)
    rendering = render(prediction.gaussians, batch.cameras)
    loss = (rendering.image - batch.images).abs().mean() + terms.depth(prediction, rendering, batch)
    loss.backward()
    for name, parameter in kicked.rounds.named_parameters():
        assert parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name
    assert any(p.grad is not None and p.grad.any() for p in kicked.encoder.parameters())
    error = [
        (m.depth - batch.depths).abs()[batch.masks & (batch.depths > 0)].mean() for m in prediction.rounds
    ]
    assert torch.isclose(terms.depth(prediction, rendering, batch), torch.stack(error).sum(), rtol=1e-5)


def test_options_are_checked():
    run_of("train", ["model=recurrent", "encoder=vggt_nano", "rounds.exchange=null"])
    assert model("rounds.exchange=null").rounds.exchange is None
    with pytest.raises(InputError, match=r"rounds: expected .* bounds"):
        GHGS.from_config(
            config(
                *RECURRENT,
                "bounds.kind=none",
                "depth_head.parameterization=inverse_linear",
                "depth_head.consistency_depths=0",
                "encoder.bounds_input=false",
            )
        )


def test_what_padding_added_is_cut_off_every_round():
    batch = make_batch(1, 2, 50, 50)
    with torch.no_grad():
        found = predict(model("model.pad=multiple", "model.frame=world", kick=0.1), batch)
    assert torch.equal(found.rounds[-1].depth, found.depth)
    assert {maps.depth.shape for maps in found.rounds} == {batch.masks.shape}


def test_each_round_changes_half_as_much_as_the_one_before():
    """For raw attributes and the range of depths, with the same output of the network in each round."""
    batch, recurrent = make_batch(1, 3), model("rounds.gains=false")
    recurrent.rounds.count = 3
    torch.nn.init.constant_(recurrent.rounds.change[-1].bias, 0.01)
    states = []
    recurrent.rounds.register_forward_hook(lambda module, inputs, found: states.extend(found))
    with torch.no_grad():
        predict(recurrent, batch)
    for name in ("offset", "scale", "rotation", "opacity"):
        values = [getattr(state.raw, name) for state in states]
        for number, (before, after) in enumerate(itertools.pairwise(values)):
            expected = torch.full_like(after, 0.01 * 0.5**number)
            torch.testing.assert_close(after - before, expected, rtol=0, atol=1e-5)
    depths = [state.depth_maps.depth[batch.masks] for state in states]
    moved = [(after - before).mean() for before, after in itertools.pairwise(depths)]
    assert moved[0] > 0
    assert float(moved[1] / moved[0]) == pytest.approx(0.5, rel=0.05)
    assert float(moved[2] / moved[0]) == pytest.approx(0.25, rel=0.05)


HEIGHT, WIDTH, KNOWN, CHANNELS = 13, 17, 6, 3


def scene(masks):
    """The Gaussians of some of the subject's pixels, as with a skip preset, and their batch."""
    image, row, column = torch.nonzero(masks, as_tuple=True)
    raw = SimpleNamespace(image=image, pixel=row * WIDTH + column, real=None)
    batch = SimpleNamespace(masks=masks[None], extents=extents(masks))
    return raw, batch


def blobs(seed=0):
    """Subjects of unequal sizes, one in a corner and one at the opposite border."""
    masks = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.bool)
    masks[0, :5, :4] = masks[1, 3:, 9:] = masks[2, 5:8, 2:15] = True
    return masks & (torch.rand(masks.shape, generator=torch.Generator().manual_seed(seed)) < 0.8)


def trained(seed=0):
    torch.manual_seed(seed)
    exchange = Exchange(KNOWN, CHANNELS).double()
    torch.nn.init.normal_(exchange.hear.weight)
    return exchange


def expected(exchange, raw, known):
    """The definition: maps of whole images, SciPy's correlation, no windows."""
    with torch.no_grad():
        told = exchange.tell(known).numpy()
    maps = np.zeros((3, HEIGHT * WIDTH, CHANNELS))
    maps[raw.image.numpy(), raw.pixel.numpy()] = told
    maps = maps.reshape(3, HEIGHT, WIDTH, CHANNELS)
    kernels, biases = (x.detach().numpy() for x in (exchange.across.weight, exchange.across.bias))
    found = np.stack(
        [
            [
                sum(correlate(m[..., c], kernel[c], "same", "direct") for c in range(CHANNELS)) + bias
                for kernel, bias in zip(kernels, biases, strict=True)
            ]
            for m in maps
        ]
    )
    rows = found[raw.image.numpy(), :, raw.pixel.numpy() // WIDTH, raw.pixel.numpy() % WIDTH]
    hear = exchange.hear.weight.detach().numpy(), exchange.hear.bias.detach().numpy()
    return known.numpy() + np.maximum(rows, 0) @ hear[0].T + hear[1]


@pytest.mark.parametrize(
    ("filled", "shape"), [([0, 1, 2], (3, 10, 13)), ([1], (3, 10, 8)), ([], (3, 1, 1))], ids=str
)
def test_windows_give_what_whole_images_give(filled, shape):
    """Also for images without a subject."""
    masks = torch.zeros(3, HEIGHT, WIDTH, dtype=torch.bool)
    masks[filled] = blobs()[filled]
    raw, batch = scene(masks)
    known, exchange = torch.randn(len(raw.image), KNOWN, dtype=torch.float64), trained()
    windows = Windows.of(raw, batch)
    assert windows.shape == shape
    found = exchange(known, windows).detach().numpy()
    assert found.shape == known.shape
    assert np.allclose(found, expected(exchange, raw, known), rtol=0, atol=1e-12)


def test_untrained_it_adds_nothing():
    raw, batch = scene(blobs())
    known = torch.randn(len(raw.image), KNOWN)
    assert torch.equal(Exchange(KNOWN, CHANNELS)(known, Windows.of(raw, batch)), known)
