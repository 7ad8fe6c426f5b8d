"""Muon compared with PyTorch's, orthogonalisation, and AdamW for parameters that are not matrices."""

from contextlib import nullcontext

import pytest
import torch
from torch import nn

from ghgs_lit.execution.graphs import GraphCache
from ghgs_lit.training import Optimization
from ghgs_lit.training.muon import Muon, is_matrix, orthogonalize
from ghgs_lit.training.optimization import convert_rates_to_numbers, hold_rates
from tests.helpers.capture_backends import OperatorBackend
from tests.helpers.pretend_device import DEVICE, pretend_device

OPTIONS = {"lr": 0.01, "betas": (0.9, 0.98), "eps": 1e-8, "weight_decay": 0.1}


class Small(nn.Module):
    """A convolution, matrices, and parameters that Muon leaves to AdamW."""

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
    """Set random gradients, equal for equal seeds."""
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator)


def test_what_counts_as_a_matrix():
    """Convolutions and linear layers with at least 3 rows and columns are matrices; tokens, biases and
    heads with two channels are not."""
    found = [name for name, parameter in Small().named_parameters() if is_matrix(parameter)]
    assert found == ["conv", "square", "tall", "wide"]
    shapes = [(3, 3), (3, 1, 3), (2, 9), (9, 2), (9,), ()]
    assert [is_matrix(nn.Parameter(torch.zeros(shape))) for shape in shapes] == [True, True] + 4 * [False]


def test_neither_scale_nor_company_matters():
    """The result depends neither on scales, even if squares underflow, nor on the other matrices; zeros stay
    zeros."""
    generator = torch.Generator().manual_seed(4)
    several = [torch.randn(shape, generator=generator) for shape in ((16, 20), (16, 20), (20, 16), (16, 99))]
    alone = [orthogonalize([matrix])[0] for matrix in several]
    scaled = [scale * matrix for scale, matrix in zip((1, 1e-30, 1e12, 1), several, strict=True)]
    zeros = torch.zeros(16, 20)
    torch.testing.assert_close(orthogonalize([*scaled, zeros]), [*alone, zeros], atol=1e-4, rtol=0)


def test_rates_on_the_device_follow_the_schedule_and_are_saved_as_numbers():
    """Learning rates stay the same tensors, which captured steps read, and checkpoints contain numbers."""
    with pretend_device():
        model = Small().to(DEVICE)
        optimizer = Optimization(lr=0.01, matrix_scale=2.0).optimizer(model)
        schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: 1 / (1 + step))
        hold_rates(optimizer)
        rates = [group["lr"] for group in optimizer.param_groups]
        for seed in range(2):
            for parameter in model.parameters():
                parameter.grad = torch.full_like(parameter, seed)
            optimizer.step()
            schedule.step()
        assert [group["lr"] for group in optimizer.param_groups] == rates
        assert [rate.item() for rate in rates] == pytest.approx([0.01 / 3, 0.02 / 3])
        files = {"optimizer_states": [optimizer.state_dict()], "lr_schedulers": [schedule.state_dict()]}
        convert_rates_to_numbers(files)
    assert [group["lr"] for group in files["optimizer_states"][0]["param_groups"]] == pytest.approx(
        [0.01 / 3, 0.02 / 3]
    )
    assert files["lr_schedulers"][0]["_last_lr"] == pytest.approx([0.01 / 3, 0.02 / 3])
    Optimization(lr=0.01, matrix_scale=2.0).optimizer(Small()).load_state_dict(files["optimizer_states"][0])


def test_matrices_move_as_with_pytorchs_muon():
    """Steps equal those of PyTorch's Muon, up to the rounding of its bfloat16 iterations over five steps."""
    ours, theirs = Small(), Small()
    flat = nn.Parameter(theirs.conv.detach().flatten(1))  # one row per output channel
    matrices = [theirs.square, theirs.tall, theirs.wide, flat]
    optimizer = Muon(ours.parameters(), matrix_lr=0.02, **OPTIONS)
    reference = torch.optim.Muon(
        matrices, lr=0.02, weight_decay=0.1, momentum=0.95, nesterov=True, adjust_lr_fn="match_rms_adamw"
    )
    before = [matrix.detach().clone() for matrix in matrices]
    for seed in range(5):
        for model in (ours, theirs):
            set_gradients(model, seed)
        flat.grad = theirs.conv.grad.flatten(1)
        optimizer.step()
        reference.step()
    moved = (ours.square, ours.tall, ours.wide, ours.conv.flatten(1))
    for one, other, start in zip(moved, matrices, before, strict=True):
        assert (one - other).norm() < 0.02 * (other - start).norm()


def test_everything_else_moves_as_with_adamw():
    """Steps equal AdamW's bit for bit, and no parameter is missed or updated twice."""
    ours, theirs = Small(), Small()
    optimizer = Muon(ours.parameters(), matrix_lr=0.02, **OPTIONS)
    adamw = torch.optim.AdamW(theirs.parameters(), **OPTIONS)
    for seed in range(3):
        for model in (ours, theirs):
            set_gradients(model, seed)
        optimizer.step()
        adamw.step()
    for name in ("output", "token", "bias"):
        assert torch.equal(getattr(ours, name), getattr(theirs, name)), name
    for name in ("conv", "square", "tall", "wide"):
        assert set(optimizer.state[getattr(ours, name)]) == {"step", "momentum"}


def test_parameters_without_gradient_stay():
    """Frozen parameters (`optimizer.freeze_until`) are not even changed by weight decay."""
    model = Small()
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    optimizer = Muon(model.parameters(), matrix_lr=0.02, **OPTIONS)
    set_gradients(model, 0)
    model.conv.grad = model.bias.grad = None
    optimizer.step()
    moved = {name for name, p in model.named_parameters() if not torch.equal(p, before[name])}
    assert moved == {"square", "tall", "wide", "output", "token"}


def take_steps(backend, capturable=True, steps=5):
    """Take steps with a schedule on the pretend device; returns the weights, and counts of captures."""
    model = Small().to(DEVICE)
    model.conv.data = model.conv.data.contiguous(memory_format=torch.channels_last)
    optimizer = Muon(model.parameters(), matrix_lr=0.02, capturable=capturable, **OPTIONS)
    optimizer.graphs = backend and GraphCache(backend=backend)
    hold_rates(optimizer)
    for seed in range(steps):
        for number, parameter in enumerate(model.parameters()):
            value = torch.linspace(-1, 1, parameter.numel()).mul(7 * number + seed + 1).sin()
            parameter.grad = value.view(parameter.shape).to(DEVICE)
        optimizer.step()
        for group in optimizer.param_groups if capturable else ():
            group["lr"].mul_(0.9)
        assert all(parameter.grad is None for parameter in model.parameters())
    weights = [parameter.detach().cpu() for parameter in model.parameters()]
    return weights, backend and dict(optimizer.graphs.counts)


@pytest.mark.parametrize("capturable", [True, False])
def test_steps_that_are_played_back_are_the_same(capturable):
    """Replayed steps equal eager ones, also for channels-last weights; neither a capture nor a failed
    attempt (AdamW that counts steps on the host) takes an extra step."""
    with pretend_device():
        wanted, _ = take_steps(None, capturable)
        with nullcontext() if capturable else pytest.warns(UserWarning, match="not captured as a CUDA graph"):
            found, counts = take_steps(OperatorBackend(), capturable)
    for one, other in zip(wanted, found, strict=True):
        assert torch.equal(one, other)
    wanted = {"eager": 2, "captured": 1, "replayed": 2} if capturable else {"eager": 4, "refused": 1}
    assert counts == wanted
