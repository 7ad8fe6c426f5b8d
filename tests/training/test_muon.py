"""Muon beside PyTorch's own, singular values, and AdamW for what is no matrix."""

from copy import deepcopy

import pytest
import torch
from torch import nn

from ghgs_lit.training import Optimization
from ghgs_lit.training.muon import Muon, is_matrix, orthogonalized

OPTIONS = {"lr": 0.01, "betas": (0.9, 0.98), "eps": 1e-8, "weight_decay": 0.1}


class Small(nn.Module):
    """A convolution, matrices and what Muon leaves to AdamW."""

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(3)
        self.conv = nn.Parameter(torch.randn(16, 4, 3, 3, generator=generator))
        self.square = nn.Parameter(torch.randn(24, 24, generator=generator))
        self.tall = nn.Parameter(torch.randn(64, 24, generator=generator))
        self.wide = nn.Parameter(torch.randn(24, 64, generator=generator))
        self.output = nn.Parameter(torch.randn(2, 24, generator=generator))
        self.token = nn.Parameter(torch.randn(1, 2, 1, 64, generator=generator))
        self.bias = nn.Parameter(torch.randn(16, generator=generator))


def set_gradients(model, seed):
    """The same random gradients for equal seeds."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator)


def test_what_counts_as_a_matrix():
    """Convolutions and linear layers from 3 rows and columns on; no tokens, biases, heads of two channels."""
    found = [name for name, parameter in Small().named_parameters() if is_matrix(parameter)]
    assert found == ["conv", "square", "tall", "wide"]
    shapes = [(3, 3), (3, 1, 3), (2, 9), (9, 2), (9,), ()]
    assert [is_matrix(nn.Parameter(torch.zeros(shape))) for shape in shapes] == [True, True] + 4 * [False]


@pytest.mark.parametrize("shape", [(3, 16, 16), (2, 16, 144), (2, 144, 16), (1, 64, 24)])
def test_singular_vectors_stay_and_singular_values_become_one(shape):
    """Beside U V^T of the decomposition, in float64: close to one is what the polynomials promise."""
    matrices = torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    u, _, v = torch.linalg.svd(matrices, full_matrices=False)
    inside = u.mT @ torch.stack(orthogonalized(matrices)) @ v.mT
    values = inside.diagonal(dim1=-2, dim2=-1)
    assert (inside - torch.diag_embed(values)).abs().max() < 1e-9
    assert values.max() < 1.2
    assert values.median() > 0.7


def test_float32_is_enough():
    """Singular values over three decades: the iterations on the Gram matrix hardly amplify rounding."""
    matrices = torch.randn(4, 32, 64, generator=torch.Generator().manual_seed(1))
    u, _, v = torch.linalg.svd(matrices, full_matrices=False)
    matrices = u @ torch.diag(torch.logspace(0, -3, 32)) @ v
    for found, expected in zip(orthogonalized(matrices), orthogonalized(matrices.double()), strict=True):
        torch.testing.assert_close(found, expected.float(), atol=5e-4, rtol=0)


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e12])
def test_scale_does_not_matter(scale):
    """Zeros stay zeros; tiny and huge gradients give the steps of others."""
    matrix = torch.randn(16, 20, generator=torch.Generator().manual_seed(2))
    expected = orthogonalized([matrix]) if scale else [torch.zeros(16, 20)]
    torch.testing.assert_close(orthogonalized([scale * matrix]), expected, atol=1e-4, rtol=0)


def test_matrices_of_one_size_do_not_meet():
    """One whose squares underflow beside an ordinary one, a tall one and a longer one."""
    generator = torch.Generator().manual_seed(4)
    several = [torch.randn(shape, generator=generator) for shape in ((16, 20), (16, 20), (20, 16), (16, 99))]
    alone = [orthogonalized([matrix])[0] for matrix in several]
    scaled = [scale * matrix for scale, matrix in zip((1, 1e-30, 1, 1), several, strict=True)]
    torch.testing.assert_close(orthogonalized(scaled), alone, atol=1e-4, rtol=0)


def test_matrices_move_as_with_pytorchs_muon():
    """PyTorch's Muon iterates in bfloat16: equal up to its rounding over five steps."""
    ours, theirs = Small(), Small()
    matrices = [theirs.square, theirs.tall, theirs.wide]
    muon = Muon(ours.parameters(), matrix_lr=0.02, **OPTIONS)
    reference = torch.optim.Muon(
        matrices, lr=0.02, weight_decay=0.1, momentum=0.95, nesterov=True, adjust_lr_fn="match_rms_adamw"
    )
    before = [matrix.detach().clone() for matrix in matrices]
    for seed in range(5):
        for model in (ours, theirs):
            set_gradients(model, seed)
        muon.step()
        reference.step()
    for one, other, start in zip((ours.square, ours.tall, ours.wide), matrices, before, strict=True):
        assert (one - other).norm() < 0.02 * (other - start).norm()


def test_a_convolution_is_a_matrix_of_its_output_channels():
    """Its step equals that of the flattened weight."""
    ours, flat = Small(), nn.Parameter(Small().conv.detach().flatten(1))
    set_gradients(ours, 0)
    flat.grad = ours.conv.grad.flatten(1)
    Muon(ours.parameters(), matrix_lr=0.02, **OPTIONS).step()
    Muon([flat], matrix_lr=0.02, **OPTIONS).step()
    torch.testing.assert_close(ours.conv.flatten(1), flat, atol=0, rtol=0)


def test_everything_else_moves_as_with_adamw():
    """Bit for bit, and no parameter is left out or moved twice."""
    ours, theirs = Small(), Small()
    muon = Muon(ours.parameters(), matrix_lr=0.02, **OPTIONS)
    adamw = torch.optim.AdamW(theirs.parameters(), **OPTIONS)
    for seed in range(3):
        for model in (ours, theirs):
            set_gradients(model, seed)
        muon.step()
        adamw.step()
    for name in ("output", "token", "bias"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    for name in ("conv", "square", "tall", "wide"):
        assert set(muon.state[getattr(ours, name)]) == {"step", "momentum"}


def test_a_resumed_run_goes_on_with_the_same_numbers():
    """Momenta, averages and both learning rates are in the state, as plain data."""
    whole, stopped = Small(), Small()
    options = Optimization(lr=0.01, matrix_scale=2.0)
    first = options.optimizer(whole)
    for seed in range(2):
        set_gradients(whole, seed)
        first.step()
    stopped.load_state_dict(whole.state_dict())
    second = options.optimizer(stopped)
    second.load_state_dict(deepcopy(first.state_dict()))
    for model, optimizer in ((whole, first), (stopped, second)):
        set_gradients(model, 9)
        optimizer.step()
    assert [group["lr"] for group in second.param_groups] == [0.01, 0.02]
    for one, other in zip(whole.parameters(), stopped.parameters(), strict=True):
        assert torch.equal(one, other)


def test_parameters_without_gradient_stay():
    """Those that are frozen for a while (`optimizer.freeze_until`), without weight decay."""
    model = Small()
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    optimizer = Muon(model.parameters(), matrix_lr=0.02, **OPTIONS)
    set_gradients(model, 0)
    model.conv.grad = model.bias.grad = None
    optimizer.step()
    moved = {name for name, p in model.named_parameters() if not torch.equal(p, before[name])}
    assert moved == {"square", "tall", "wide", "output", "token"}
