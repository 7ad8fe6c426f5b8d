"""Values of maps, against SciPy."""

import numpy as np
import torch
from scipy.ndimage import map_coordinates

from ghgs_lit.geometry.projection import sample


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
    """A batch without a Gaussian is observed like any other."""
    assert sample(torch.rand(2, 5, 4, 4), torch.zeros(0, 3).long(), torch.zeros(0, 3, 2)).shape == (0, 3, 5)


def test_double_precision_is_kept():
    """The map was chosen by a number in single precision: some of the next one came along."""
    maps = torch.zeros(3, 1, 4, 4, dtype=torch.float64)
    maps[1] = 1
    found = sample(maps, torch.tensor([0, 2]), torch.full((2, 2), 2.0, dtype=torch.float64))
    assert found.abs().max() < 1e-12
