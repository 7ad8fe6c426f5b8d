"""Projection, unprojection and bilinear sampling, against products of matrices and SciPy."""

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from ghgs_lit.geometry.projection import inverse_intrinsics, project, sample, unproject
from tests.helpers.scenes import CENTER, ring


def test_the_inverse_of_intrinsics_is_the_inverse_of_the_matrix():
    """Focal lengths, skew and principal point are all different."""
    intrinsics = torch.tensor(
        [[[900.0, 3.0, 250.0], [0.0, 800.0, 260.0], [0.0, 0.0, 1.0]]], dtype=torch.float64
    )
    intrinsics = torch.cat((intrinsics, torch.eye(3, dtype=torch.float64)[None]))
    torch.testing.assert_close(inverse_intrinsics(intrinsics), torch.linalg.inv(intrinsics))
    assert inverse_intrinsics(intrinsics.half()).dtype == torch.float32


def test_projection_is_the_product_of_matrices_and_unprojection_its_inverse():
    """Against homogeneous coordinates in float64, with a rotated and translated camera with skew for each
    point."""
    generator = torch.Generator().manual_seed(0)
    n, options = 50, {"dtype": torch.float64, "generator": generator}
    intrinsics = torch.eye(3, dtype=torch.float64).repeat(n, 1, 1)
    intrinsics[:, :2] = torch.tensor([[900.0, 3.0, 250.0], [0.0, 800.0, 260.0]]) * (
        1 + torch.rand(n, 2, 3, **options)
    )
    extrinsics = torch.eye(4, dtype=torch.float64).repeat(n, 1, 1)
    turns = torch.randn(n, 4, **options)
    extrinsics[:, :3, :3] = torch.from_numpy(Rotation.from_quat(turns.numpy()).as_matrix())
    extrinsics[:, :3, 3] = torch.randn(n, 3, **options)
    points = 3 * torch.randn(n, 3, **options)
    camera = extrinsics @ torch.nn.functional.pad(points, (0, 1), value=1.0)[..., None]
    expected = (intrinsics @ camera[:, :3])[..., 0]
    pixels, depth = project(points, intrinsics, extrinsics)
    front = depth > 0
    assert 10 < front.sum() < n
    torch.testing.assert_close(depth, expected[:, 2])
    torch.testing.assert_close(pixels[front], (expected[:, :2] / expected[:, 2:])[front])
    torch.testing.assert_close(unproject(pixels, depth, intrinsics, extrinsics)[front], points[front])


def test_resized_cameras_see_points_at_the_same_share_of_the_photograph():
    """Rows scale with the height and columns with the width of images that are not square."""
    cameras = ring(1, 2, 40, 64)
    points = CENTER + 0.2 * torch.randn(7, 3, generator=torch.Generator().manual_seed(0))

    def seen(cameras):
        lens, pose = (matrix[0, :, None] for matrix in (cameras.intrinsics, cameras.extrinsics))
        return project(points.expand(2, 7, 3), lens, pose)[0]

    expected = seen(cameras) * torch.tensor([32 / 64, 120 / 40])
    torch.testing.assert_close(seen(cameras.resize(120, 32)), expected)


def test_sampling_is_bilinear_and_0_outside():
    generator = torch.Generator().manual_seed(0)
    maps = torch.rand(5, 2, 9, 7, generator=generator)
    image = torch.randint(5, (40,), generator=generator)
    pixels = torch.rand(40, 2, generator=generator) * torch.tensor([7.0, 9.0])
    found = sample(maps, image, pixels)
    for n in range(40):
        place = (pixels[n].flip(0) - 0.5).double().numpy()[:, None]
        for c in range(2):
            expected = map_coordinates(
                np.pad(maps[image[n], c].double().numpy(), 1), place + 1, order=1, mode="constant"
            )[0]
            assert abs(found[n, c].item() - expected) < 1e-5
    assert not sample(maps, image[:2], torch.tensor([[-1e9, 3.0], [3.0, 1e9]])).any()


def test_no_pixels_have_no_values():
    """Sampling at no pixels returns no values, for a batch without Gaussians."""
    assert sample(torch.rand(2, 5, 4, 4), torch.zeros(0, 3).long(), torch.zeros(0, 3, 2)).shape == (0, 3, 5)


def test_double_precision_is_kept():
    """Regression: indices of maps were single precision, which mixed in some of the next map."""
    maps = torch.zeros(3, 1, 4, 4, dtype=torch.float64)
    maps[1] = 1
    found = sample(maps, torch.tensor([0, 2]), torch.full((2, 2), 2.0, dtype=torch.float64))
    assert found.abs().max() < 1e-12
