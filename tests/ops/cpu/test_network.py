"""The kernel of the rounds' network against plain PyTorch."""

import functools

import pytest
import torch

from ghgs_lit.method.rounds import RoundsOptions
from ghgs_lit.ops import pool
from ghgs_lit.ops.observation import CHANNELS
from ghgs_lit.ops.round_memory import remembered

#: What is known beside what views show, of ``depths=8``.
KNOWN = 13


def scene(hidden, views, count, seed=0):
    """Rounds, and inputs of their network for ``count`` Gaussians."""
    torch.manual_seed(seed)
    rounds = RoundsOptions(hidden=hidden).build(16).eval()
    return rounds, (
        torch.randn(count, views, CHANNELS),
        torch.randn(count, KNOWN),
        torch.randn(count, hidden),
    )


def fused(rounds, rows):
    with torch.no_grad():
        return remembered(rounds._layers, *rows)


@pytest.mark.parametrize(("hidden", "views", "count"), [(48, 4, 1111), (17, 2, 33), (5, 3, 1), (64, 5, 32)])
def test_the_kernel_remembers_what_plain_pytorch_does(hidden, views, count):
    rounds, rows = scene(hidden, views, count)
    expected = remembered(rounds.double()._layers, *(x.double() for x in rows))
    found = fused(rounds.float(), rows)
    assert expected.std() > 0.1
    torch.testing.assert_close(found.double(), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("hidden", "views", "count"), [(48, 4, 2500), (17, 2, 33), (5, 3, 1), (64, 5, 32)])
def test_gradients_are_those_of_plain_pytorch(hidden, views, count):
    """Those of more Gaussians than one task has, of views that show the same,
    and of a single Gaussian."""
    rounds, (each, known, before) = scene(hidden, views, count)
    each[::3, 1] = each[::3, -1]  # two views without the Gaussian show the same
    weights = torch.randn(count, hidden)

    def gradients(forward, dtype):
        rounds.to(dtype)
        rows = [x.to(dtype) for x in (each, known, before)]
        layers = [p for part in (rounds.view, rounds.update, rounds.memory) for p in part.parameters()]
        after = forward(*rows[:2], rows[2].requires_grad_())
        return torch.autograd.grad((after * weights.to(dtype)).sum(), [rows[2], *layers])

    fused = functools.partial(remembered, rounds._layers)
    found = gradients(fused, torch.float32)
    for mine, expected in zip(found, gradients(fused, torch.float64), strict=True):
        assert (mine - expected).norm() < 2e-6 * expected.norm()


def test_the_number_of_threads_and_other_gaussians_change_no_bit():
    rounds, rows = scene(48, 4, 5000)
    layers = [rounds.view[0].weight, rounds.update[0].weight, rounds.memory.bias]
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            after = remembered(rounds._layers, *rows)
            found.append((after, *torch.autograd.grad(after.square().sum(), layers)))
    finally:
        torch.set_num_threads(threads)
    for one, three in zip(*found, strict=True):
        assert torch.equal(one, three)
    assert torch.equal(fused(rounds, [x[1000:1010] for x in rows]), found[0][0][1000:1010])


@pytest.mark.parametrize("row", [0, 1, 2])
def test_what_is_not_finite_reaches_no_other_gaussian(row):
    rounds, rows = scene(48, 3, 40)
    expected = fused(rounds, rows)
    rows[row][7] = torch.nan
    found = fused(rounds, rows)
    assert found[7].isnan().all()
    others = torch.arange(40) != 7
    assert torch.equal(found[others], expected[others])


def test_where_the_kernel_is_used(monkeypatch):
    """Not in another precision, or where a processor has no fused products."""
    monkeypatch.setattr(pool, "features", lambda: {"avx2", "fma"})
    x = torch.ones(3)
    assert pool.multiplies(x)
    assert not pool.multiplies(x, x.double())
    with torch.autocast("cpu", torch.bfloat16):
        assert not pool.multiplies(x)
    monkeypatch.setattr(pool, "features", lambda: {"avx2"})
    assert not pool.multiplies(x)
