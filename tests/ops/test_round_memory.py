"""Kernels of the rounds' memory against plain PyTorch in float64, on a CPU with gradients."""

import functools

import pytest
import torch
from torch import nn

from ghgs_lit.geometry.precision import _float32
from ghgs_lit.method.rounds import RoundsOptions
from ghgs_lit.ops import pool
from ghgs_lit.ops.dispatch import OPERATORS
from ghgs_lit.ops.observation import CHANNELS
from ghgs_lit.ops.round_memory import plain, remembered
from tests.helpers.kernels import DEVICE, kernels

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


def test_other_gaussians_change_no_bit():
    rounds, rows = scene(48, 4, 5000)
    assert torch.equal(fused(rounds, [x[1000:1010] for x in rows]), fused(rounds, rows)[1000:1010])


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


def rows_of(count, views, channels, hidden, more):
    generator = torch.Generator().manual_seed(0)
    sizes = ((count, views, channels), (count, more), (count, hidden))
    each, known, memory = (torch.randn(size, generator=generator) for size in sizes)
    return each, known, torch.tanh(memory)


def layers_of(channels, hidden, more):
    torch.manual_seed(1)
    sizes = ((channels, hidden), (hidden, hidden), (4 * hidden + more, 2 * hidden), (2 * hidden, hidden))
    return [nn.Linear(*size).to(DEVICE) for size in (*sizes, (hidden, hidden))]


@pytest.mark.parametrize("size", [(70, 4, 11, 48, 24), (1, 2, 11, 16, 13), (65, 5, 3, 40, 40)])
@torch.no_grad()
def test_memory_is_that_of_plain_pytorch(size):
    """To the rounding of factors to TF32 on a GPU, and of float32 in the interpreter."""
    inputs = [value.to(DEVICE) for value in rows_of(*size)]
    layers = layers_of(*size[2:])
    weights = [tensor.double() for layer in layers for tensor in (layer.weight, layer.bias)]
    wanted = plain(*(value.double() for value in inputs), weights)
    with kernels() as called, _float32(DEVICE.type, True):
        found = remembered(layers, *inputs)
    assert called == ["remember"]
    assert not found.isnan().any()
    assert (found - wanted).abs().max() < (2e-3 if DEVICE.type == "cuda" else 5e-6)


@torch.no_grad()
def test_a_value_that_is_not_a_number_stays_in_its_row():
    each, known, memory = rows_of(70, 4, 11, 48, 24)
    each[3, 2, 5] = float("nan")
    with kernels(), _float32(DEVICE.type, True):
        found = remembered(layers_of(11, 48, 24), each.to(DEVICE), known.to(DEVICE), memory.to(DEVICE))
    assert found[3].isnan().all()
    assert found.isnan().any(1).sum() == 1


@pytest.mark.parametrize("has_gradient", [False, True])
@pytest.mark.parametrize("rounding", [False, True])
def test_float32_and_gradients_are_plain_pytorchs(rounding, has_gradient):
    """Where products may not round to TF32, and where a gradient is wanted."""
    inputs = [value.to(DEVICE) for value in rows_of(3, 2, 11, 48, 24)]
    with kernels(), torch.set_grad_enabled(has_gradient), _float32(DEVICE.type, rounding):
        assert OPERATORS["remember"].has_kernel(*inputs, []) == (rounding and not has_gradient)
