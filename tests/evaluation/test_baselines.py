"""Baselines on analytic scenes: input views, splats at the depth of the hull, of a plane sweep or of the
data, and splats fitted per scene."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from PIL import Image

from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.baselines import (
    BASELINES,
    CHANGES,
    _average_in_window,
    baseline,
    discs_at,
    hull_bounds,
    hull_depth,
    nearest_view,
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
from ghgs_lit.metrics.functional import ssim
from ghgs_lit.refinement import refinement
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, DepthMaps, Points, Targets
from tests.helpers.scenes import CENTER, RADII, make_batch, painted_ellipsoid, with_soft_rims
from tests.helpers.scenes import ring as ring_around
from tests.helpers.training import batched, example_batch, flat_renderer, ring

RENDERER = Renderer(backend="cpu")


@pytest.mark.parametrize("views", [3, 5])
def test_the_nearest_view_is_the_one_beside_the_target(views):
    """The baseline copies the nearest camera on either side, also across the start of the ring."""
    batch = example_batch(subjects=2, views=views, targets=2)
    step = 2 * math.pi / views
    # the first target is next to view 2 on the far side, the second next to view 0
    near = dataclasses.replace(ring(2, 16))
    cameras = ring(1, 16, start=2 * step + 0.4 * step), ring(1, 16, start=-0.4 * step)
    near = dataclasses.replace(near, extrinsics=torch.cat([c.extrinsics for c in cameras]))
    batch = dataclasses.replace(batch, targets=dataclasses.replace(batch.targets, cameras=batched(near, 2)))
    image = nearest_view(batch).image
    assert torch.equal(image[:, 0], batch.images[:, 2])
    assert torch.equal(image[:, 1], batch.images[:, 0])


@pytest.mark.parametrize("size", [(8, 8), (4, 12), (32, 24)])
def test_the_nearest_view_is_resized_as_photographs_are(size):
    """As in Pillow, downsampling averages the area of a pixel, upsampling interpolates."""
    batch = example_batch(subjects=1, views=2, size=16)
    masks = torch.zeros(1, 1, *size, dtype=torch.bool)
    targets = dataclasses.replace(batch.targets, images=torch.zeros(1, 1, 3, *size), masks=masks)
    found = nearest_view(dataclasses.replace(batch, targets=targets)).image[0, 0]
    for channel, photo in zip(found, batch.images[0, 0], strict=True):
        expected = Image.fromarray(photo.numpy()).resize(size[::-1], Image.Resampling.BILINEAR)
        torch.testing.assert_close(channel, torch.from_numpy(np.array(expected)), atol=1e-5, rtol=0)


def test_splats_lie_on_their_pixels_with_their_width_in_pixels():
    """Splats project to the centres of their pixels, with the configured width."""
    batch = example_batch(views=2)
    depth = torch.full(batch.masks.shape, 1.7)
    gaussians = splats_at(batch, depth, batch.masks, sigma=0.5, opacity=0.8)
    assert gaussians.splits == tuple(batch.masks.flatten(1).sum(1).tolist())
    first = gaussians[0]
    seen = int(batch.masks[0, 0].sum())
    pixels, z = project(first.means[:seen], batch.cameras.intrinsics[0, 0], batch.cameras.extrinsics[0, 0])
    rows, columns = batch.masks[0, 0].nonzero(as_tuple=True)
    assert torch.allclose(pixels, torch.stack((columns + 0.5, rows + 0.5), -1), atol=1e-4)
    assert torch.allclose(z, torch.full_like(z, 1.7), atol=1e-5)
    # 0.5 pixels at depth 1.7 under a focal length of 16 pixels
    assert torch.allclose(first.scales, torch.full_like(first.scales, 0.5 * 1.7 / 16))
    assert torch.equal(first.colors[:seen], batch.images[0, 0].movedim(0, -1)[batch.masks[0, 0]])


def test_what_the_data_lacks_is_an_error():
    """A baseline that the data cannot support is rejected, as is an unknown name."""
    with pytest.raises(InputError, match="true_depth"):
        baseline("true_depth", flat_renderer, 1)(dataclasses.replace(example_batch(), depths=None))
    with pytest.raises(InputError, match="baselines"):
        baseline("white", flat_renderer, 1)


@pytest.fixture(scope="module")
def painted():
    """A painted ellipsoid from several sides for each of two subjects, with targets of another size."""
    cameras, seen = ring_around(2, 6, 32, 32), ring_around(2, 4, 40, 24)[:, 1:3]
    images, masks, depths = painted_ellipsoid(cameras)
    images[1] = 1 - images[1]
    photographs, subjects, _ = painted_ellipsoid(seen)
    photographs[1] = 1 - photographs[1]
    directions = torch.randn(60, 3, generator=torch.Generator().manual_seed(0))
    surface = CENTER + RADII * torch.nn.functional.normalize(directions, dim=-1)
    images, photographs = images * masks[:, :, None], photographs * subjects[:, :, None]
    targets = Targets(photographs, subjects, seen)
    return Batch(images, masks, cameras, targets, depths=depths, body_vertices=[surface, surface])


@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_predicts_the_targets(name, painted):
    """Targets may differ from inputs in size and number; each subject is predicted from its inputs."""
    truth = painted.targets.images
    image = baseline(name, RENDERER, 1)(painted).image
    assert image.shape == truth.shape == (2, 2, 3, 40, 24)
    # Nearer to the truth than to black, and to the other subject's.
    error = (image - truth).square().flatten(1).mean(1)
    assert (error < truth.square().flatten(1).mean(1) / 2).all()
    assert (error < (image.flip(0) - truth).square().flatten(1).mean(1)).all()


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
    cameras = ring_around(1, views, height, width)
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
    around = ring_around(1, 2 * views, size, size)
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


def test_only_gaussians_fitted_per_scene_compute_ssim(monkeypatch):
    """Refinement of a prediction gains nothing from it; it would take most of the time."""
    calls = []
    monkeypatch.setattr(refinement, "ssim", lambda *a, **k: calls.append(1) or ssim(*a, **k))
    batch = scene()
    refinement.Refinement(2, RENDERER)(start_scene(batch), batch)
    assert calls == []
    per_scene(batch, RENDERER, steps=3)
    assert calls == [1, 1, 1]


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
