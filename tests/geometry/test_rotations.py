"""Quaternions against SciPy."""

import math

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ghgs_lit.geometry.rotations import (
    matrix_to_quaternion,
    multiply_quaternions,
    quaternion_to_matrix,
    rotate,
)


def test_quaternions_of_matrices_and_their_products():
    """At half turns as well, where the real part is 0."""
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
