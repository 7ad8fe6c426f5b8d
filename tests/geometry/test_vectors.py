"""Directions of vectors of any length."""

import pytest
import torch

from ghgs_lit.geometry.rotations import unit


@pytest.mark.parametrize("length", [1e-30, 1e-20, 1.0, 1e19, 1e30])
def test_a_direction_and_its_gradient_do_not_depend_on_the_length(length):
    """Squares vanished below 5e-14, where the gradient became infinite,
    and overflowed from 1e19 on."""
    vector = torch.tensor([0.48, -0.6, 0.64, 0.0])
    x = (vector * length).requires_grad_()
    y = unit(x)
    torch.testing.assert_close(y.detach(), vector, rtol=1e-6, atol=1e-7)
    (gradient,) = torch.autograd.grad(y[0], x)
    expected = torch.eye(4)[0] - vector[0] * vector
    torch.testing.assert_close(gradient * length, expected, rtol=1e-5, atol=1e-6)


def test_zero_stays_zero_without_a_gradient():
    """It has no direction, and its gradient must not become NaN."""
    x = torch.zeros(2, 4, requires_grad=True)
    y = unit(x, 0.1)
    y.sum().backward()
    assert (y == 0).all()
    assert (x.grad == 0).all()


def test_a_gradient_is_bounded_where_that_is_asked_for():
    """Near the zero quaternion one splat would own the whole clipped gradient."""
    vector = torch.tensor([0.6, 0.8])
    for length in (1e-12, 1e-3, 0.1, 5.0):
        x = (vector * length).requires_grad_()
        (gradient,) = torch.autograd.grad(unit(x, 0.1)[0], x)
        assert gradient.norm() == pytest.approx(0.8 / max(length, 0.1), rel=1e-4)


def test_gradients_are_those_of_finite_differences():
    x = torch.randn(5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(unit, (x.requires_grad_(),))
