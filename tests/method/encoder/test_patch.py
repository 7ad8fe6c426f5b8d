"""The convolutional stem reads only kept patches and those in their receptive field."""

import pytest
import torch

from ghgs_lit.method.encoder.vit import ConvStem
from ghgs_lit.method.plan.patches import KeptPatches

GRID = (2, 2, 9, 11)


def kept(*places: tuple[int, int, int, int]) -> KeptPatches:
    found = torch.zeros(GRID, dtype=torch.bool)
    for place in places:
        found[place] = True
    return KeptPatches(found, torch.device("cpu"))


@pytest.mark.parametrize("patch_size", [7, 14, 16, 28])
@pytest.mark.parametrize(
    "places", [[(0, 0, 4, 5)], [(0, 0, 3, 4), (1, 1, 5, 2)], [(0, 1, 0, 10), (1, 0, 8, 0)]]
)
def test_kept_patches_have_the_tokens_of_whole_images(patch_size, places):
    stem = ConvStem(5, 16, patch_size, 8).double()
    images = torch.randn(4, 5, 9 * patch_size, 11 * patch_size, dtype=torch.double)
    everything = KeptPatches(torch.ones(GRID, dtype=torch.bool), images.device)
    some = kept(*places)
    torch.testing.assert_close(stem(images, some), stem(images, everything)[some.index])


def test_what_kept_patches_do_not_depend_on_is_not_seen():
    """NaN in other patches would reach every token through a sum."""
    stem, some = ConvStem(5, 16, 14, 8), kept((0, 0, 4, 5))
    images = torch.full((4, 5, 126, 154), torch.nan)
    images[..., 2 * 14 : 7 * 14, 3 * 14 : 8 * 14] = 0.5
    assert stem(images, some).isfinite().all()


def test_no_kept_patch():
    assert ConvStem(5, 16, 14, 8)(torch.rand(4, 5, 126, 154), kept()).shape == (0, 16)


def test_the_box_holds_the_kept_patches_of_all_images():
    """The margin is clipped to the grid; without kept patches the box is one patch, through which
    gradients of 0 flow."""
    assert kept((0, 0, 3, 4), (1, 1, 5, 2)).box(1) == (slice(2, 7), slice(1, 6))
    assert kept((0, 1, 0, 10), (1, 0, 8, 9)).box(2) == (slice(0, 9), slice(7, 11))
    assert kept().box(0) == (slice(0, 1), slice(0, 1))
