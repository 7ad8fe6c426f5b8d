"""The kernel of the rounds' network against plain PyTorch."""

import pytest
import torch
from torch import nn

from ghgs_lit.kernels import pool
from ghgs_lit.rounds import RoundsOptions, cpu
from ghgs_lit.rounds.observation import CHANNELS

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
        return cpu.remembered(rounds.view, rounds.update, rounds.memory, *rows)


@pytest.mark.parametrize(("hidden", "views", "count"), [(48, 4, 1111), (17, 2, 33), (5, 3, 1), (64, 5, 32)])
def test_the_kernel_remembers_what_plain_pytorch_does(hidden, views, count):
    rounds, rows = scene(hidden, views, count)
    expected = rounds.double()._remembered(*(x.double() for x in rows))
    found = fused(rounds.float(), rows)
    assert expected.std() > 0.1
    torch.testing.assert_close(found.double(), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize(("hidden", "channels", "count"), [(48, 16, 1111), (17, 5, 33)])
@torch.no_grad()
def test_the_kernel_answers_as_plain_pytorch_does(hidden, channels, count):
    torch.manual_seed(0)
    hear, change = nn.Linear(channels, hidden), nn.Linear(hidden, 15)
    heard, before = torch.randn(count, channels), torch.randn(count, hidden)
    after, changed = cpu.answered(hear, change, heard, before)
    expected = before + hear(heard.relu())
    torch.testing.assert_close(after, expected, atol=1e-5, rtol=0)
    torch.testing.assert_close(changed, change(expected), atol=1e-5, rtol=0)


def test_the_number_of_threads_and_other_gaussians_change_no_bit():
    rounds, rows = scene(48, 4, 3000)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = fused(rounds, rows)
        torch.set_num_threads(3)
        assert torch.equal(fused(rounds, rows), one)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(fused(rounds, [x[1000:1010] for x in rows]), one[1000:1010])


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
    """Not with a gradient, in another precision, or where a processor has no fused products."""
    monkeypatch.setattr(pool, "features", lambda: {"avx2", "fma"})
    x = torch.ones(3)
    assert not pool.multiplies(x)
    with torch.no_grad():
        assert pool.multiplies(x)
        assert not pool.multiplies(x, x.double())
        with torch.autocast("cpu", torch.bfloat16):
            assert not pool.multiplies(x)
        monkeypatch.setattr(pool, "features", lambda: {"avx2"})
        assert not pool.multiplies(x)
