"""CPU and GPU kernels of the memory of rounds, and gradients on a CPU, compared with plain PyTorch in
float64."""

import pytest
import torch
from torch import nn

from ghgs_lit.geometry.precision import _float32
from ghgs_lit.ops import pool
from ghgs_lit.ops.dispatch import OPERATORS
from ghgs_lit.ops.round_memory import update_memory
from tests.helpers.kernels import DEVICE, WHERE, kernels

#: Gaussians, views, channels of a view, width of the memory, and number of additional inputs.
SIZES = [
    (1111, 4, 11, 48, 13),
    (33, 2, 11, 17, 13),
    (1, 3, 11, 5, 13),
    (65, 5, 3, 40, 40),
    (32, 5, 11, 64, 24),
]


def scene(count, views, channels, hidden, known):
    """Five layers and their inputs: observations, additional inputs and the previous memory."""
    torch.manual_seed(0)
    sizes = ((channels, hidden), (hidden, hidden), (4 * hidden + known, 2 * hidden), (2 * hidden, hidden))
    layers = nn.Sequential(*(nn.Linear(*size) for size in (*sizes, (hidden, hidden))))
    rows = [torch.randn(count, *size) for size in ((views, channels), (known,), (hidden,))]
    return layers, [*rows[:2], rows[2].tanh()]


@torch.no_grad()
def by_kernel(kind, layers, rows):
    with kernels(kind) as called, _float32(WHERE[kind].type, True):
        found = update_memory(layers.to(WHERE[kind]), *(x.to(WHERE[kind]) for x in rows))
    assert called == ["remember"]
    return found.cpu()


@pytest.mark.parametrize("kind", WHERE)
@pytest.mark.parametrize("size", SIZES)
@torch.no_grad()
def test_the_kernel_remembers_what_plain_pytorch_does(kind, size):
    """The tolerance follows from rounding to TF32 on a GPU, and to float32 elsewhere."""
    layers, rows = scene(*size)
    expected = update_memory(layers.double(), *(x.double() for x in rows))
    found = by_kernel(kind, layers.float(), rows)
    limit = {"cpu": 1e-6, "cuda": 2e-3 if DEVICE.type == "cuda" else 5e-6}[kind]
    assert expected.std() > 0.1
    torch.testing.assert_close(found.double(), expected, atol=limit, rtol=0)


@pytest.mark.parametrize("size", [(2500, 4, 11, 48, 13), *SIZES[1:]])
def test_gradients_are_those_of_plain_pytorch(size):
    """Cases cover more Gaussians than one task has, views with equal observations, and a single
    Gaussian."""
    layers, rows = scene(*size)
    rows[0][::3, 1] = rows[0][::3, -1]  # as in two views without the Gaussian
    weights = torch.randn(size[0], size[3])

    def gradients(dtype):
        layers.to(dtype)
        each, known, before = (x.to(dtype) for x in rows)
        after = update_memory(layers, each, known, before.requires_grad_())
        return torch.autograd.grad((after * weights.to(dtype)).sum(), [before, *layers.parameters()])

    with kernels("cpu") as called:
        found = gradients(torch.float32)
    assert called == ["remember"]
    for mine, expected in zip(found, gradients(torch.float64), strict=True):
        assert (mine - expected).norm() < 2e-6 * expected.norm()


def test_other_gaussians_change_no_bit():
    layers, rows = scene(5000, 4, 11, 48, 13)
    alone = by_kernel("cpu", layers, [x[1000:1010] for x in rows])
    assert torch.equal(alone, by_kernel("cpu", layers, rows)[1000:1010])


@pytest.mark.parametrize("kind", WHERE)
@pytest.mark.parametrize("row", [0, 1, 2])
def test_what_is_not_finite_reaches_no_other_gaussian(kind, row):
    layers, rows = scene(40, 3, 11, 48, 13)
    expected = by_kernel(kind, layers, rows)
    rows[row].view(40, -1)[7, -5] = torch.nan
    found = by_kernel(kind, layers, rows)
    assert found[7].isnan().all()
    others = torch.arange(40) != 7
    assert torch.equal(found[others], expected[others])


def test_where_the_kernel_is_used(monkeypatch):
    """The kernel is not used in other precisions or on processors without fused multiply-add."""
    monkeypatch.setattr(pool, "features", lambda: {"avx2", "fma"})
    x = torch.ones(3)
    assert pool.multiplies(x)
    assert not pool.multiplies(x, x.double())
    with torch.autocast("cpu", torch.bfloat16):
        assert not pool.multiplies(x)
    monkeypatch.setattr(pool, "features", lambda: {"avx2"})
    assert not pool.multiplies(x)


@pytest.mark.parametrize("has_gradient", [False, True])
@pytest.mark.parametrize("rounding", [False, True])
def test_float32_and_gradients_are_plain_pytorchs(rounding, has_gradient):
    """The GPU kernel is not used where TF32 is disabled or a gradient is required."""
    inputs = [x.to(DEVICE) for x in scene(3, 2, 11, 48, 24)[1]]
    with kernels(), torch.set_grad_enabled(has_gradient), _float32(DEVICE.type, rounding):
        assert OPERATORS["remember"].has_kernel(*inputs, []) == (rounding and not has_gradient)
