"""Between pixels and the world."""

import torch

from ghgs_lit.geometry.projection import inverse_intrinsics


def test_the_inverse_of_intrinsics_is_the_inverse_of_the_matrix():
    """Focal lengths of two axes, a skew and a principal point, all different."""
    intrinsics = torch.tensor(
        [[[900.0, 3.0, 250.0], [0.0, 800.0, 260.0], [0.0, 0.0, 1.0]]], dtype=torch.float64
    )
    intrinsics = torch.cat((intrinsics, torch.eye(3, dtype=torch.float64)[None]))
    torch.testing.assert_close(inverse_intrinsics(intrinsics), torch.linalg.inv(intrinsics))
    assert inverse_intrinsics(intrinsics.half()).dtype == torch.float32
