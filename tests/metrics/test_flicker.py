"""Flicker of hand-made images of a plane."""

import pytest
import torch

from ghgs_lit.metrics.flicker import flicker, flicker_in_place
from ghgs_lit.types import Cameras

SIDE, FOCAL, DISTANCE = 24, 12.0, 2.0
INTRINSICS = torch.tensor([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])
CAMERAS = Cameras(INTRINSICS.expand(2, 1, 3, 3), torch.eye(4).expand(2, 1, 4, 4), SIDE, SIDE)
#: Pixels that a square is moved by.
STEP = 3


def points_at(pixels: torch.Tensor) -> torch.Tensor:
    """Points [n, 3] of a plane that are seen at pixels (u, v)."""
    flat = (pixels - SIDE / 2) / FOCAL * DISTANCE
    return torch.cat((flat, torch.full_like(flat[:, :1], DISTANCE)), 1)


@pytest.fixture
def square():
    """A textured square that moves to the right: photographs, points, depths, masks."""
    g = torch.Generator().manual_seed(0)
    texture, photographs = torch.rand(3, 8, 8, generator=g), torch.zeros(2, 1, 3, SIDE, SIDE)
    masks = torch.zeros(2, 1, SIDE, SIDE, dtype=torch.bool)
    for instant in range(2):
        rows, columns = slice(6, 14), slice(4 + STEP * instant, 12 + STEP * instant)
        photographs[instant, 0, :, rows, columns] = texture
        masks[instant, 0, rows, columns] = True
    # Not at centres of pixels, so that sampling has to be bilinear; away from the silhouette.
    pixels = torch.tensor([5.0, 7.0]) + 6 * torch.rand(50, 2, generator=g)
    points = torch.stack([points_at(pixels), points_at(pixels + torch.tensor([STEP, 0.0]))])
    return photographs, points, DISTANCE * masks.float(), masks


def test_a_textured_square_that_is_tracked_does_not_flicker(square):
    """Its whole picture is the error, which moves with it; it does change at places that do not."""
    photographs, points, depths, masks = square
    assert flicker(photographs, points, depths, CAMERAS) < 1e-6
    assert flicker(photographs, points[:1].expand(2, -1, -1), depths, CAMERAS) > 0.1
    assert flicker_in_place(photographs, masks) > 0.1


def test_an_error_that_stays_does_not_flicker_and_one_that_alternates_does(square):
    """An error of +d and then -d changes by 2 d everywhere."""
    photographs, points, depths, masks = square
    d = 0.1
    constant = torch.full_like(photographs, d)
    alternating = constant * torch.tensor([1.0, -1.0])[:, None, None, None, None]
    assert flicker(constant, points, depths, CAMERAS) < 1e-6
    assert flicker(alternating, points, depths, CAMERAS).item() == pytest.approx(2 * d, abs=1e-5)
    assert flicker_in_place(constant, masks) == 0
    assert flicker_in_place(alternating, masks).item() == pytest.approx(2 * d, abs=1e-5)


def test_only_the_box_of_both_instants_counts_in_place(square):
    photographs, _, _, masks = square
    errors = torch.zeros_like(photographs)
    errors[1, ..., 6:14, 4:15] = 1  # the box: eight rows, eleven columns
    assert flicker_in_place(errors, masks) == 1
    errors[1, ..., 6:14, 4:12] = 0  # what is left lies in the box of the second alone
    assert flicker_in_place(errors, masks).item() == pytest.approx(3 / 11)
    errors[1, ..., 6:14, 4:15] = 0
    errors[1, ..., :6, :] = 1
    assert flicker_in_place(errors, masks) == 0


def test_points_that_are_hidden_at_one_instant_are_left_out(square):
    """Something stands before the lower rows at the second one, and is all wrong."""
    photographs, points, depths, _ = square
    errors = torch.zeros_like(photographs)
    errors[1, ..., 10:, :] = 1
    assert flicker(errors, points, depths, CAMERAS) > 0.1
    depths[1, :, 10:] = DISTANCE - 0.1
    rows = points[0, :, 1] / DISTANCE * FOCAL + SIDE / 2
    assert ((rows > 8) & (rows < 9.5)).any()
    assert flicker(errors, points, depths, CAMERAS) < 1e-6
    assert flicker(errors, points[:, rows > 10.5], depths, CAMERAS).isnan()


def test_nothing_to_compare_is_undefined(square):
    """No point in sight, no point at all, all of them behind the camera,
    no subject in the masks."""
    photographs, points, depths, masks = square
    assert flicker(photographs, points, 0 * depths, CAMERAS).isnan()
    assert flicker(photographs, points[:, :0], depths, CAMERAS).isnan()
    assert flicker(photographs, -points, depths, CAMERAS).isnan()
    assert flicker_in_place(photographs, masks & False).isnan()
