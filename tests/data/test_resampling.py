"""Resizing shifts nothing, or reproduces the authors' code."""

from pathlib import Path

import numpy as np
import pytest

from ghgs_lit.config import build, compose
from ghgs_lit.data.view import (
    View,
    area_image,
    area_mask,
    encode_depth,
    release_image,
    release_mask,
    resample_depth,
    resize_view,
)
from ghgs_lit.errors import InputError
from tests.helpers.people import render_boxes

FIXTURES = Path(__file__).parents[1] / "fixtures"
# Recorded from OpenCV 5.0 (nearest neighbour) and Pillow 13.0 (bicubic).
RECORDED = dict(np.load(FIXTURES / "release_loading.npz"))
# Ratios of 2:1 and 7.5:1, two odd ratios, and an enlargement.
SIZES = [(96, 48), (150, 20), (96, 52), (97, 41), (40, 64)]


def slow_means(image: np.ndarray, size: int) -> np.ndarray:
    """Reference in float64: means over the areas of new pixels of a square image [n, n]."""
    n = len(image)
    edges = np.arange(size + 1) * n / size
    weights = np.clip(
        np.minimum(edges[1:, None], np.arange(n) + 1) - np.maximum(edges[:-1, None], np.arange(n)), 0, None
    )
    weights /= weights.sum(1, keepdims=True)
    return weights @ image.astype(np.float64) @ weights.T


def ellipse(size: int, rng: np.random.Generator) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] + 0.5
    x, y = size / 2 + rng.uniform(-2, 2, 2)
    return ((columns - x) / 0.35) ** 2 + ((rows - y) / 0.3) ** 2 < size**2


def middle(mask: np.ndarray) -> np.ndarray:
    return np.stack(np.nonzero(mask)).mean(1) + 0.5


@pytest.mark.parametrize("size", ["half", "odd"])
def test_release_resizes_as_opencv_and_pillow(size):
    """Results equal those recorded from the libraries, for masks and images."""
    image, mask = RECORDED[f"photograph_bicubic_{size}"], RECORDED[f"mask_nearest_{size}"][..., 0]
    np.testing.assert_array_equal(release_image(RECORDED["photograph"], *image.shape[:2]), image)
    np.testing.assert_array_equal(release_mask(RECORDED["mask"][..., 0], *mask.shape), mask)
    view = View(RECORDED["photograph"], RECORDED["mask"][..., 0] > 0, None, np.eye(3), np.eye(4))
    resized = resize_view(view, mask.shape, "release")
    np.testing.assert_array_equal(resized.image, image)
    np.testing.assert_array_equal(resized.mask, mask > 0)


@pytest.mark.parametrize(("old", "new"), [pair for pair in SIZES if pair[0] > pair[1]])
def test_photographs_shrink_by_exact_areas(old, new):
    """Each new pixel is the mean over its area, up to rounding to 8 bits."""
    image = np.random.default_rng(0).integers(0, 256, (old, old, 3), dtype=np.uint8)
    expected = slow_means(image[..., 0], new)
    assert np.abs(area_image(image, new, new)[..., 0] - expected).max() <= 0.501


@pytest.mark.parametrize(("old", "new"), SIZES)
def test_masks_stay_at_their_place(old, new):
    """The centre of a mask moves by less than 0.05 pixels on average, at any ratio."""
    rng = np.random.default_rng(1)
    moved, grown = [], []
    for _ in range(30):
        mask = ellipse(old, rng)
        resized = area_mask(mask, new, new)
        moved.append(middle(resized) - middle(mask) * new / old)
        grown.append(resized.sum() / mask.sum() * (old / new) ** 2)
    assert np.abs(np.mean(moved, 0)).max() < 0.05
    assert abs(np.mean(grown) - 1) < 0.03
    expected = slow_means(mask, new)
    clear = np.abs(expected - 0.5) > 1e-6
    np.testing.assert_array_equal(resized[clear], expected[clear] > 0.5)


@pytest.mark.parametrize(("old", "new"), SIZES)
def test_depth_is_that_of_the_new_centres(old, new):
    """The depth of a slanted plane is exact within the rounding of the format, and a step keeps its two
    depths."""
    rows, columns = np.mgrid[:old, :old] + 0.5
    inverse = np.round(12000 + 20 * rows - 15 * columns).astype(np.uint16)
    rows, columns = (np.mgrid[:new, :new] + 0.5) * old / new
    expected = 12000 + 20 * rows - 15 * columns
    inner = slice(1, -1)
    found = resample_depth(inverse, new, new)[inner, inner]
    assert np.abs(found - expected[inner, inner]).max() <= 1.01
    step = np.where(np.arange(old) < old // 2 + 1, 16000, 8000) * np.ones((old, 1), int)
    step[:, -old // 4 :] = 0
    assert set(np.unique(resample_depth(step.astype(np.uint16), new, new))) == {0, 8000, 16000}


def test_a_resized_view_has_depth_in_its_mask_only():
    """After halving, depths are known exactly where the mask is true."""
    mask = ellipse(96, np.random.default_rng(2))
    inverse = encode_depth(np.where(mask, 2.0, 0))
    view = View(np.zeros((96, 96, 3), np.uint8), mask, inverse, np.eye(3), np.eye(4))
    for resampling in ("area", "release"):
        halved = resize_view(view, (48, 48), resampling)
        np.testing.assert_array_equal(halved.inverse_depth > 0, halved.mask)


def test_the_release_protocol_loads_as_the_release(tmp_path):
    """experiment=thuman2 and data=thuman2_release resize as the authors' code, others by areas."""
    render_boxes(tmp_path / "root", tmp_path / "scans", train=1, val=1)
    for override, resampling, centers in (
        ("experiment=thuman2", "release", "half"),
        ("data=thuman2_release", "release", "half"),
        ("data=thuman2", "area", "auto"),
        ("data=thuman2_rogsplat", "area", "auto"),
    ):
        cfg = compose("train", [override, f"data.root={tmp_path / 'root'}", "data.size=21"])
        data = build(cfg.data, "data", views=cfg.views, targets=cfg.targets, seed=0)
        assert data.facts == {"name": "thuman2", "pixel_centers": centers, "resampling": resampling}
        assert data.photographs("val").resampling == resampling
        assert data.dataset.reader("val")._shift == 0
    with pytest.raises(InputError, match=r"data\.resampling: expected one of area, release; found 'cubic'"):
        build({**cfg.data, "resampling": "cubic"}, "data", views=cfg.views, targets=cfg.targets, seed=0)
