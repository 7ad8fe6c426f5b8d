"""Photo-consistency, compared with a pixel-by-pixel version that uses SciPy's interpolation, and its
kernels, compared with plain PyTorch."""

import dataclasses

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates, uniform_filter

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.ops import photo_consistency as stage
from ghgs_lit.ops.photo_consistency import TOLERANCE, photo_consistency
from ghgs_lit.types import DepthBounds
from tests.helpers.kernels import WHERE, kernels
from tests.helpers.scenes import in_dtype, make_batch, ring
from tests.method.heads.test_gaussian import make_head, run, shake


def by_hand(batch, bounds, b, v, row, column, steps):
    """Agreement at one pixel in float64; in these scenes all views are within the limit of angles."""
    masks = batch.masks[b].double().numpy()
    images = batch.images[b].double().numpy() * masks[:, None]
    intrinsics, extrinsics = (
        x[b].double().numpy() for x in (batch.cameras.intrinsics, batch.cameras.extrinsics)
    )
    weight = np.stack([uniform_filter(m, 3, mode="constant") for m in masks])
    smooth = np.stack([[uniform_filter(c, 3, mode="constant") for c in image] for image in images])
    smooth = smooth / np.where(weight > 1e-9, weight, 1)[:, None]
    near, far = (float(bound[b, v, row, column]) for bound in (bounds.near, bounds.far))
    found = []
    for step in range(steps):
        z = near + (far - near) * (step + 0.5) / steps
        ray = np.linalg.inv(intrinsics[v]) @ [column + 0.5, row + 0.5, 1]
        world = extrinsics[v, :3, :3].T @ (z * ray - extrinsics[v, :3, 3])
        best = 0.0
        for k in range(len(masks)):
            if k != v:
                pixel = intrinsics[k] @ (extrinsics[k, :3, :3] @ world + extrinsics[k, :3, 3])
                at = [[pixel[1] / pixel[2] - 0.5], [pixel[0] / pixel[2] - 0.5]]
                inside, *color = (
                    map_coordinates(x, at, order=1, mode="grid-constant")[0] for x in (masks[k], *smooth[k])
                )
                difference = np.abs(np.array(color) - smooth[v, :, row, column]).mean()
                best = max(best, np.exp(-difference / TOLERANCE) * inside)
        found.append(best)
    return found


@pytest.mark.parametrize("size", [(42, 56), (56, 42)])
def test_agreement_is_that_of_each_ray(size):
    """The batched plane sweep must equal a pixel-by-pixel version."""
    batch = make_batch(2, 3, *size, spread=150.0)
    bounds = VisualHull()(batch)
    maps = photo_consistency(batch, bounds, 5)
    assert maps.shape == (2, 3, 5, *size)
    places = batch.masks.nonzero()
    for b, v, row, column in places[:: max(1, len(places) // 25)].tolist():
        expected = by_hand(batch, bounds, b, v, row, column, 5)
        np.testing.assert_allclose(maps[b, v, :, row, column].numpy(), expected, atol=2e-4)


def test_the_surface_agrees_more_than_what_lies_behind_it():
    """A subject whose colour is a smooth function of position, in neighbouring views."""
    batch = make_batch(1, 4, 56, 56, spread=100.0)

    points = unproject_maps(batch.depths, batch.cameras)
    colors = (points * 9).sin() / 2 + 0.5
    images = colors.movedim(-1, 2) * batch.masks[:, :, None]
    batch = dataclasses.replace(batch, images=images)
    at = photo_consistency(batch, DepthBounds(batch.depths, batch.depths), 1)[:, :, 0][batch.masks]
    deeper = DepthBounds(batch.depths + 0.15, batch.depths + 0.15)
    behind = photo_consistency(batch, deeper, 1)[:, :, 0][batch.masks]
    assert at.mean() > 0.75
    assert behind.mean() < at.mean() - 0.25


@pytest.mark.parametrize("size", [56, 518])
def test_half_precision_does_not_reach_the_sweep(size):
    """A pixel coordinate rounded to bfloat16 is another pixel, which would break the guide in training."""
    batch = make_batch(1, 4, size, size, spread=100.0)
    bounds = DepthBounds(batch.depths, batch.depths + 0.05)
    expected = photo_consistency(batch, bounds, 2)
    centers = batch.cameras.centers
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(photo_consistency(batch, bounds, 2), expected)
        assert torch.equal(batch.cameras.centers, centers)


def test_opposite_views_say_nothing():
    """Views from opposite sides share no surface and must not be compared."""
    batch = make_batch(1, 2)
    bounds = VisualHull()(batch)
    assert not photo_consistency(batch, bounds, 4).any()


def test_empty_masks_have_no_agreement():
    batch = make_batch(1, 3)
    empty = dataclasses.replace(batch, masks=torch.zeros_like(batch.masks))
    depth = batch.depths.clamp(min=1)
    assert not photo_consistency(empty, DepthBounds(depth, depth), 2).any()


def test_the_order_of_views_does_not_matter():
    """The best other view must not depend on the order of views."""
    batch = make_batch(1, 3, spread=250.0)
    order = [2, 0, 1]
    turned = dataclasses.replace(
        batch,
        images=batch.images[:, order],
        masks=batch.masks[:, order],
        depths=batch.depths[:, order],
        cameras=dataclasses.replace(
            batch.cameras,
            intrinsics=batch.cameras.intrinsics[:, order],
            extrinsics=batch.cameras.extrinsics[:, order],
        ),
    )
    first = photo_consistency(batch, DepthBounds(batch.depths, batch.depths + 0.2), 3)
    second = photo_consistency(turned, DepthBounds(turned.depths, turned.depths + 0.2), 3)
    torch.testing.assert_close(first[:, order], second)


def test_splats_see_photo_consistency_and_colors_leave_their_pixels_within_the_limit():
    """The guide must reach the opacities, and colours must stay within their limit."""
    batch = make_batch(1, 3, spread=250.0)
    other = dataclasses.replace(batch, cameras=ring(1, 3, 56, 56, spread=200.0))
    head = shake(make_head(guide=True, photo_consistency=True, color_limit=0.25))
    pixels = batch.images.permute(0, 1, 3, 4, 2)[batch.masks]
    assert torch.equal(run(head, batch).colors, pixels)
    torch.nn.init.normal_(head.color_header[-1].weight)
    here, there = run(head, batch), run(head, other)
    assert not torch.equal(here.opacities, there.opacities)
    change = (here.colors - pixels).abs()
    assert 0 < change.max() <= 0.25


def test_rims_agree_as_if_they_were_not_premultiplied():
    """Images on black are darker where the subject covers a pixel in part."""
    batch = make_batch(1, 3)
    share = (
        0.3 + 0.7 * torch.rand(batch.masks.shape, generator=torch.Generator().manual_seed(1))
    ) * batch.masks
    mixed = dataclasses.replace(batch, images=batch.images * share[:, :, None], alpha=share)
    bounds = DepthBounds(batch.depths - 0.1, batch.depths + 0.1)
    expected = photo_consistency(batch, bounds, 4)
    torch.testing.assert_close(photo_consistency(mixed, bounds, 4), expected, atol=1e-5, rtol=1e-4)
    dark = photo_consistency(dataclasses.replace(mixed, alpha=None), bounds, 4)
    assert (dark - expected).abs().max() > 0.1


SCENES = [(2, 4, 28, 42, 360.0), (1, 5, 42, 28, 360.0), (2, 2, 28, 28, 60.0), (1, 3, 56, 56, 150.0)]
EPS = torch.finfo(torch.float32).eps


@pytest.mark.parametrize("kind", WHERE)
@pytest.mark.parametrize("steps", [1, 5])
@pytest.mark.parametrize(("b", "v", "height", "width", "spread"), SCENES)
def test_the_agreement_is_as_exact_as_plain_pytorchs(kind, b, v, height, width, spread, steps):
    """Cases cover points behind cameras and outside frames, an empty view and a pixel that is not finite."""
    batch = make_batch(b, v, height, width, spread=spread)
    batch.masks[-1, 0] = False
    batch.images[0, -1, :, height // 2, width // 2] = torch.nan
    hull = VisualHull()(batch)
    for bounds in (hull, DepthBounds(-hull.far, hull.far)):
        exact = photo_consistency(in_dtype(batch, torch.float64), bounds.to(torch.float64), steps)
        assert exact.dtype == torch.float64
        fresh = dataclasses.replace(batch).to(WHERE[kind])
        with kernels(kind) as called:
            found = photo_consistency(fresh, bounds.to(WHERE[kind]), steps)
        assert called[-1] == "swept"
        # Pixel coordinates are exact to roundings of the frame's size times the ratio of the depth to
        # the smallest depth in front of a camera; colours change by at most 1 per pixel, and the
        # agreement by 1 / TOLERANCE of that.
        assert ((found >= 0) & (found <= 1)).all()
        difference = (found.cpu() - exact).abs()
        assert difference.max() < 1e-3
        assert difference.mean() < 64 * EPS / stage.TOLERANCE


@pytest.mark.parametrize("kind", WHERE)
def test_strides_change_nothing_and_no_pixel_has_no_agreement(kind):
    batch = make_batch(2, 3, 28, 42)
    near, far = (bound.flatten()[batch.pixels] for bound in dataclasses.astuple(VisualHull()(batch)))
    strided = dataclasses.replace(
        batch, images=batch.images.transpose(3, 4).contiguous().transpose(3, 4), masks=batch.masks.clone()
    )
    apart = near.repeat_interleave(2)[::2]
    pixels = batch.pixels
    cases = (
        (batch, pixels, near, far),
        (strided, pixels, apart, far),
        (batch, pixels[:0], near[:0], far[:0]),
    )
    with kernels(kind):
        expected, found, none = (
            stage.consistency_of(*(x.to(WHERE[kind]) for x in case), 3) for case in cases
        )
    assert torch.equal(found, expected)
    assert none.shape == (0, 3)
