"""Quaternions against SciPy, normalisation of vectors of any length, and relative motions of cameras."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ghgs_lit.geometry.rotations import (
    apply_motions,
    matrix_to_quaternion,
    motions_between,
    multiply_quaternions,
    quaternion_to_matrix,
    remove_common_motion,
    rigid,
    rotate,
    unit,
)
from tests.helpers.scenes import ring


def test_quaternions_of_matrices_and_their_products():
    """Includes half turns, whose real part is 0."""
    vectors = np.concatenate((np.random.default_rng(0).normal(size=(40, 3)), math.pi * np.eye(3)))
    matrices = torch.from_numpy(Rotation.from_rotvec(vectors).as_matrix())
    found = matrix_to_quaternion(matrices)
    torch.testing.assert_close(quaternion_to_matrix(found), matrices, atol=1e-12, rtol=0)
    product = multiply_quaternions(found, found.roll(1, 0))
    torch.testing.assert_close(
        quaternion_to_matrix(product), matrices @ matrices.roll(1, 0), atol=1e-12, rtol=0
    )
    moved = rotate(found, torch.from_numpy(vectors).flip(0))
    expected = Rotation.from_rotvec(vectors).apply(vectors[::-1])
    torch.testing.assert_close(moved, torch.from_numpy(expected), atol=1e-12, rtol=0)


@pytest.mark.parametrize("length", [1e-30, 1e-20, 1.0, 1e19, 1e30])
def test_a_direction_and_its_gradient_do_not_depend_on_the_length(length):
    """Regression: squares vanished below 5e-14, where the gradient became infinite, and overflowed from
    1e19 on."""
    vector = torch.tensor([0.48, -0.6, 0.64, 0.0])
    x = (vector * length).requires_grad_()
    y = unit(x)
    torch.testing.assert_close(y.detach(), vector, rtol=1e-6, atol=1e-7)
    (gradient,) = torch.autograd.grad(y[0], x)
    expected = torch.eye(4)[0] - vector[0] * vector
    torch.testing.assert_close(gradient * length, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("least", [(), (0.1,)])
def test_zero_stays_zero_without_a_gradient(least):
    """0 has no direction, and its gradient must not be NaN."""
    x = torch.zeros(2, 4, requires_grad=True)
    y = unit(x, *least)
    y.sum().backward()
    assert (y == 0).all()
    assert (x.grad == 0).all()


def test_a_gradient_is_bounded_where_that_is_asked_for():
    """Near the zero quaternion, a single splat would dominate the clipped gradient."""
    vector = torch.tensor([0.6, 0.8])
    for length in (1e-12, 1e-3, 0.1, 5.0):
        x = (vector * length).requires_grad_()
        (gradient,) = torch.autograd.grad(unit(x, 0.1)[0], x)
        assert gradient.norm() == pytest.approx(0.8 / max(length, 0.1), rel=1e-4)


def test_gradients_are_those_of_finite_differences():
    x = torch.randn(5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert torch.autograd.gradcheck(unit, (x.requires_grad_(),))


def test_what_cameras_share_is_taken_out_and_the_rest_stays():
    """A common rotation, translation and shift along the optical axes are removed; differences keep their
    size."""
    g = torch.Generator().manual_seed(0)
    axes = torch.nn.functional.normalize(torch.randn(2, 4, 3, generator=g), dim=-1)
    motions = torch.randn(2, 4, 6, generator=g)
    shared = torch.randn(2, 1, 6, generator=g).expand(-1, 4, -1).clone()
    apart = remove_common_motion(motions, axes)
    torch.testing.assert_close(remove_common_motion(motions + shared, axes), apart, rtol=0, atol=1e-5)
    assert (apart[..., :3].mean(1)).abs().max() < 1e-6
    assert (apart[..., 3:] * axes).sum(-1).mean(1).abs().max() < 1e-6
    turns = motions[..., :3] - motions[..., :3].mean(1, keepdim=True)
    torch.testing.assert_close(apart[..., :3], turns)


def test_what_cameras_share_is_what_photographs_show():
    """The left and right cameras move along their optical axes, which is hardly visible: the others must
    stay."""
    axes = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    motions = torch.zeros(4, 6)
    motions[:, 3] = torch.tensor([0.1, 0.0, -0.1, 0.0])
    # The two motions are opposite and have no common part.
    torch.testing.assert_close(remove_common_motion(motions, axes), motions)
    along = motions.clone()
    along[1, 3] = 1.0
    across = remove_common_motion(along, axes)[[0, 2], 3] - motions[[0, 2], 3]
    assert across.abs().max() < 0.01


def test_small_motions_turn_and_shift_points():
    """A rotation by 0.01 moves a point by that fraction of its distance from the axis; shifts have a unit."""
    rotation, shift = rigid(torch.tensor([0.0, 0.0, 0.01, 0.0, 0.0, 0.5]), length=2.0)
    point = rotation @ torch.tensor([1.0, 0.0, 0.0]) + shift
    torch.testing.assert_close(point, torch.tensor([1.0, 0.01, 1.0]), rtol=0, atol=1e-4)


def test_cameras_that_moved_tell_their_motions():
    """Motions are recovered from the cameras, also a kilometre away from the world's origin."""
    middle = torch.tensor([1000.0, 1.0, -500.0], dtype=torch.float64)
    before = ring(1, 4, 42, 42).extrinsics[0].double()
    before[:, :3, 3] -= before[:, :3, :3] @ middle
    motions = 1e-3 * torch.randn(4, 6, generator=torch.Generator().manual_seed(1)).double()
    after = apply_motions(before, motions, middle)
    found = motions_between(before, after, middle)
    torch.testing.assert_close(found, motions, rtol=1e-5, atol=1e-9)
    point = middle + 0.3
    rotations, shifts = rigid(motions)
    moved = (rotations @ (point - middle)) + middle + shifts
    seen = (before[:, :3, :3] @ moved[..., None])[..., 0] + before[:, :3, 3]
    torch.testing.assert_close(after[:, :3, :3] @ point + after[:, :3, 3], seen, rtol=0, atol=1e-9)
