"""Splats at the depth of the hull, of a plane sweep or of the data, and fitted per scene."""

import dataclasses

import pytest
import torch

from ghgs_lit.config import run_of
from ghgs_lit.evaluation.baselines import (
    CHANGES,
    _average_in_window,
    discs_at,
    hull_bounds,
    hull_depth,
    per_scene,
    photo_depth,
    render_discs,
    splats_at,
    start_scene,
    true_depth,
)
from ghgs_lit.geometry.masks import with_matte
from ghgs_lit.geometry.projection import project, unproject_maps
from ghgs_lit.method.heads.attributes import RawGaussians
from ghgs_lit.metrics import psnr
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, DepthMaps, Points, Targets
from tests.helpers.scenes import make_batch, painted_ellipsoid, ring, with_soft_rims

RENDERER = Renderer(backend="cpu")


def test_splats_have_the_surfaces_own_colors():
    """Rims of an image with a matte are darker than the surface; the splats are not."""
    batch = with_soft_rims(make_batch(1, 2))
    valid = batch.masks & (batch.depths > 0)
    found = splats_at(batch, batch.depths, valid).colors
    share = batch.alpha[valid][:, None]
    expected = (batch.images.movedim(2, -1)[valid] / share).clamp(max=1)
    assert (share < 0.9).sum() > 20
    torch.testing.assert_close(found, expected)


def test_discs_are_those_that_the_recurrent_model_starts_from():
    """The model's Gaussian head predicts the same discs for raw values of 0 at the same points."""
    run = run_of("train", ["model=recurrent"])
    head = run.gaussian_head.build(dim_latent=64)
    batch = with_matte(with_soft_rims(make_batch(2, 3)), run.model.matte)
    valid = batch.masks & (batch.depths > 0)
    image, pixel = valid.flatten(0, 1).flatten(1).nonzero().unbind(1)
    n = len(image)
    splits = tuple(valid.flatten(1).sum(1).tolist())
    zeros = (torch.zeros(n, 3), torch.zeros(n, 3), torch.zeros(n, 4), torch.zeros(n), torch.zeros(n, 3))
    raw = RawGaussians(torch.zeros(n, head.decoder.full_channels), *zeros, image, pixel, splits)
    maps = DepthMaps(batch.depths, valid, batch.depths)
    tokens = (torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool), torch.zeros(0, dtype=torch.long))
    points = Points(unproject_maps(batch.depths, batch.cameras), valid, *tokens)
    expected = head.activate(raw, batch, points, maps)
    found = discs_at(batch, batch.depths, valid)
    for field in dataclasses.fields(found):
        value = getattr(found, field.name)
        torch.testing.assert_close(value, getattr(expected, field.name), msg=lambda m, f=field: f.name + m)


def test_pixels_that_show_little_of_the_subject_have_discs_too():
    """Their opacity is the matte: without them outlines would end at half a pixel."""
    batch = with_soft_rims(make_batch(1, 2))
    own = Targets(batch.images[:, :1], batch.masks[:, :1], batch.cameras[:, :1])
    deep = torch.where(batch.depths > 0, batch.depths, 2.0)
    found = render_discs(dataclasses.replace(batch, targets=own, depths=deep), true_depth, RENDERER)
    expected = batch.alpha > 0.125
    assert torch.equal(found.depth_valid, expected)
    assert expected.sum() > (batch.masks & expected).sum()


@pytest.mark.parametrize("splatting", [splats_at, discs_at])
def test_sizes_are_of_each_views_own_focal_length(splatting):
    """Doubling the focal length of one view halves the size of its splats only."""
    batch = make_batch(2, 3)
    lenses = batch.cameras.intrinsics.clone()
    lenses[1, 2, [0, 1], [0, 1]] *= 2
    longer = dataclasses.replace(batch, cameras=dataclasses.replace(batch.cameras, intrinsics=lenses))
    found, given = (splatting(one, batch.depths, batch.masks) for one in (longer, batch))
    expected = torch.where(found.image == 5, 0.5, 1.0)[:, None] * given.scales
    torch.testing.assert_close(found.scales, expected)


def errors(views):
    """Depths of the hull minus the true ones inside the silhouettes, in pixel footprints."""
    batch = make_batch(views=views, height=160, width=160)
    difference = (hull_depth(batch) - batch.depths)[batch.masks]
    return difference * batch.cameras.intrinsics[0, 0, 0, 0] / batch.depths[batch.masks]


def test_the_hull_of_a_convex_body_approaches_its_surface_with_more_views():
    """A convex body is the intersection of its silhouette cones; with few cones the hull is too thick."""
    few, many = errors(3), errors(24)
    assert many.max() < 0  # never behind the surface
    assert many.median() > -1.6  # masks are dilated by a pixel
    assert few.median() < -2.4
    assert many.abs().mean() < 0.6 * few.abs().mean()


def photographed(views=8, height=64, width=56):
    cameras = ring(1, views, height, width)
    images, masks, depths = painted_ellipsoid(cameras)
    return Batch(images, masks, cameras, depths=depths)


def test_colours_say_where_in_the_hull_the_surface_is():
    """Depths are closer to the truth than the hull's front and middle, on images that are not square."""
    batch = photographed()
    found, bounds = photo_depth(batch), batch.once(hull_bounds)

    def error(depth):
        return (depth - batch.depths)[batch.masks].abs().mean()

    assert error(found) < 0.6 * error(hull_depth(batch))
    assert error(found) < 0.6 * error((bounds.near + bounds.far) / 2)
    assert (found[~batch.masks] == 0).all()
    inside = found[batch.masks]
    assert (inside >= bounds.near[batch.masks]).all()
    assert (inside <= bounds.far[batch.masks]).all()


def test_a_body_of_one_colour_stands_between_the_ends_of_its_hull():
    """Where all depths are equally consistent the result is their mean, not the first or a random one."""
    batch = photographed(views=4)
    batch = Batch(0.5 * batch.masks[:, :, None].expand_as(batch.images), batch.masks, batch.cameras)
    bounds = batch.once(hull_bounds)
    share = ((photo_depth(batch) - bounds.near) / (bounds.far - bounds.near))[batch.masks]
    assert share.median() == pytest.approx(0.5, abs=0.2)


def test_evidence_is_shared_inside_the_subject_only():
    """The result is a mean over pixels of the mask in the window, by definition."""
    generator = torch.Generator().manual_seed(0)
    values = torch.rand(2, 3, 4, 9, 7, generator=generator)
    masks = torch.rand(2, 3, 9, 7, generator=generator) > 0.4
    found = _average_in_window(values, masks, 2)
    for b, v, row, column in masks.nonzero()[::11].tolist():
        window = (b, v, slice(max(row - 2, 0), row + 3), slice(max(column - 2, 0), column + 3))
        part = values[window[0], window[1], :, window[2], window[3]]
        expected = part[:, masks[window]].mean(1)
        assert torch.allclose(found[b, v, :, row, column], expected, atol=1e-5)


def scene(views=4, size=42):
    """Input views of a painted ellipsoid, with the second one as the target."""
    around = ring(1, 2 * views, size, size)
    images, masks, _ = painted_ellipsoid(around)
    own = Targets(images[:, 2:3], masks[:, 2:3], around[:, 2:3])
    return Batch(images[:, ::2], masks[:, ::2], around[:, ::2], own)


def test_the_photographs_are_fitted():
    """Steps improve the render of an input by far more than refinement may."""
    batch = scene()
    begin = RENDERER(start_scene(batch), batch.targets.cameras).image
    fitted = per_scene(batch, RENDERER, steps=40)
    before, after = (psnr(i[0].clamp(0, 1), batch.targets.images[0]).item() for i in (begin, fitted.image))
    assert after > before + 8
    assert fitted.gaussians.splits == (int(batch.masks.sum()),)


def test_every_gaussian_begins_on_its_pixel_and_may_become_another():
    """Gaussians start at photo-consistent depths; position, rotation, scale, opacity and colour all
    change."""
    batch = scene()
    begin = start_scene(batch)
    seen = int(batch.masks[0, 0].sum())
    _, depth = project(begin.means[:seen], batch.cameras.intrinsics[0, 0], batch.cameras.extrinsics[0, 0])
    assert torch.allclose(depth, photo_depth(batch)[0, 0][batch.masks[0, 0]], atol=1e-5)
    fitted = per_scene(batch, RENDERER, steps=3).gaussians
    for name in CHANGES:
        assert (getattr(fitted, name) != getattr(begin, name)).float().mean() > 0.5, name
