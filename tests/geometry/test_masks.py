"""Masks: premultiplied images, distances to outlines, and rays of a silhouette against the visual hull of
others."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from ghgs_lit.geometry.masks import (
    coverage,
    signed_distance,
    soft_signed_distance,
    surface_colors,
    with_matte,
)
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette
from tests.helpers.scenes import make_batch


def matted_batch():
    """Images of known colours, premultiplied by mattes that include 0 and 1."""
    batch = make_batch(2, 3)
    generator = torch.Generator().manual_seed(2)
    colors, share = (
        torch.rand(shape, generator=generator) for shape in (batch.images.shape, batch.masks.shape)
    )
    share = torch.where(share < 0.2, 0, torch.where(share > 0.8, 1, share))
    images = colors * share[:, :, None]
    return colors, dataclasses.replace(batch, images=images, alpha=share, masks=share >= 0.5)


def test_colors_are_those_before_premultiplication():
    """Pixels with a matte of 0 are unchanged, and rounding errors of a file give no colour above 1."""
    colors, batch = matted_batch()
    shown = (batch.alpha > 0)[:, :, None]
    found = surface_colors(batch)
    torch.testing.assert_close(found, torch.where(shown, colors, batch.images))
    noisy = surface_colors(dataclasses.replace(batch, images=batch.images + 4 / 255))
    assert noisy.isfinite().all()
    assert torch.where(shown, noisy, 0).max() <= 1
    half = dataclasses.replace(batch, images=batch.images.bfloat16(), alpha=batch.alpha.bfloat16())
    assert surface_colors(half).dtype == torch.float32


def test_without_a_matte_nothing_changes():
    """With binary masks, images are returned unchanged and masks as shares."""
    _, batch = matted_batch()
    plain = dataclasses.replace(batch, alpha=None)
    assert surface_colors(plain) is plain.images
    assert torch.equal(coverage(plain), plain.masks.float())
    assert torch.equal(coverage(batch), batch.alpha)
    assert with_matte(plain, 0.1) is plain


def test_masks_grow_to_what_shows_enough_of_the_subject():
    """Masks follow a threshold of the matte; None drops the matte."""
    _, batch = matted_batch()
    grown = with_matte(batch, 0.125)
    assert torch.equal(grown.masks, batch.alpha > 0.125)
    assert grown.alpha is batch.alpha
    left_out = with_matte(batch, None)
    assert left_out.alpha is None
    assert torch.equal(left_out.masks, batch.masks)


def test_the_outline_runs_half_way_between_pixels():
    """Distances equal those to the nearest pixel on the other side, found by brute force."""
    mask = np.random.default_rng(0).uniform(size=(14, 11)) < 0.5
    places = np.argwhere(np.ones_like(mask))
    apart = cdist(places, places)
    apart[mask.ravel()[:, None] == mask.ravel()] = np.inf
    expected = (apart.min(1).reshape(mask.shape) - 0.5) * np.where(mask, 1, -1)
    np.testing.assert_allclose(signed_distance(mask), expected, atol=1e-6)


@pytest.mark.parametrize("value", [False, True])
def test_without_an_outline_all_is_infinitely_far(value):
    assert (signed_distance(np.full((3, 4), value)) == (np.inf if value else -np.inf)).all()


def test_soft_outlines_are_found_to_fractions_of_a_pixel():
    """Distances of a disc from its matte, also where a straight cut leaves no fractional pixel."""
    fine = np.hypot(*((np.indices((320, 320)) + 0.5) / 8 - 20.3)) < 12.4
    matte = fine.reshape(40, 8, 40, 8).mean((1, 3))
    expected = 12.4 - np.hypot(*(np.indices((40, 40)) + 0.5 - 20.3))
    soft, hard = (
        np.abs(found - expected) for found in (soft_signed_distance(matte), signed_distance(matte > 0.5))
    )
    near = np.abs(expected) < 4
    assert soft[near].max() < 0.6
    assert soft[near].mean() < 0.55 * hard[near].mean()
    cut = np.where(np.arange(40) < 20, matte, 0)
    np.testing.assert_allclose(soft_signed_distance(cut)[20, 14:26], 19.5 - np.arange(14, 26), atol=1e-6)
    assert (soft_signed_distance((matte > 0.5) * 1.0) == signed_distance(matte > 0.5)).all()


def camera(turn, cells):
    """Intrinsics of an image of ``cells`` x ``cells``, and extrinsics 4 m from the origin, rotated around
    it."""
    sine, cosine = np.sin(turn), np.cos(turn)
    extrinsics = np.eye(4)
    extrinsics[:3] = [[cosine, 0, sine, 0], [0, 1, 0, 0], [-sine, 0, cosine, 4]]
    return np.array([[2 * cells, 0, cells / 2], [0, 2 * cells, cells / 2], [0, 0, 1.0]]), extrinsics


@pytest.mark.parametrize(("row", "agrees"), [(24, True), (19, False)])
def test_rays_pass_the_middle_of_cells(row, agrees):
    """Cells are eight times as large as those of the hull, which lies above the row of the ray through
    their corner."""
    mask = np.zeros((8, 8), bool)
    mask[3, 3:5] = True
    others = []
    for turn in (1.2, -1.2):
        fine = np.zeros((64, 64), bool)
        fine[row + 3 : row + 6] = True
        others.append(Silhouette(fine, *camera(turn, 64)))
    silhouettes = [Silhouette(mask, *camera(0, 8)), *others]
    assert HullSearch().shares(silhouettes)[0] == agrees
