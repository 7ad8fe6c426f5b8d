"""The GPU's kernel of the rounds' memory against plain PyTorch in float64."""

import pytest
import torch
from torch import nn

from ghgs_lit.geometry.precision import _float32
from ghgs_lit.ops.dispatch import OPERATORS
from ghgs_lit.ops.round_memory import plain, remembered
from tests.helpers.kernels import DEVICE, kernels


def rows(count, views, channels, hidden, more):
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
    inputs = [value.to(DEVICE) for value in rows(*size)]
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
    each, known, memory = rows(70, 4, 11, 48, 24)
    each[3, 2, 5] = float("nan")
    with kernels(), _float32(DEVICE.type, True):
        found = remembered(layers_of(11, 48, 24), each.to(DEVICE), known.to(DEVICE), memory.to(DEVICE))
    assert found[3].isnan().all()
    assert found.isnan().any(1).sum() == 1


@pytest.mark.parametrize("has_gradient", [False, True])
@pytest.mark.parametrize("rounding", [False, True])
def test_float32_and_gradients_are_plain_pytorchs(rounding, has_gradient):
    """Where products may not round to TF32, and where a gradient is wanted."""
    inputs = [value.to(DEVICE) for value in rows(3, 2, 11, 48, 24)]
    with kernels(), torch.set_grad_enabled(has_gradient), _float32(DEVICE.type, rounding):
        assert OPERATORS["remember"].has_kernel(*inputs, []) == (rounding and not has_gradient)
