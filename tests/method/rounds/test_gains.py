"""Cameras with different exposures: their gains are estimated and removed."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from ghgs_lit.data.imperfections import sample_color_gains
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.rounds.gains import divide_by_gains, equalize, log_gains, log_gammas
from tests.helpers.models import make_model
from tests.helpers.scenes import CENTER, RADII, ellipsoid, make_batch, surface_splats, with_soft_rims


def waves(points):
    return 0.5 + 0.3 * torch.sin(points * torch.tensor([9.0, 5.0, 7.0]))


def halves(points):
    """Colours that are slightly darker in front than behind."""
    return torch.where(points[..., 2:] > CENTER[2], 0.46, 0.4).expand(points.shape)


def painted_batch(batch=1, views=4, spread=40.0, paint=waves, radii=RADII):
    """A surface whose colour depends on the position in the world, so that all views agree."""
    batch = make_batch(batch, views, spread=spread)
    masks, depths = ellipsoid(batch.cameras, radii=radii)
    batch = dataclasses.replace(batch, masks=masks, depths=depths)
    colors = paint(unproject_maps(batch.depths, batch.cameras)).movedim(-1, 2)
    return dataclasses.replace(batch, images=colors * batch.masks[:, :, None])


def seen_with(batch, gains):
    return dataclasses.replace(batch, images=batch.images * torch.as_tensor(gains)[..., None, None].float())


def sample_gains(batch, seed=0, stops=0.5):
    rng = np.random.default_rng(seed)
    return np.stack([sample_color_gains(batch.masks.shape[1], stops, stops / 2, rng) for _ in batch.masks])


@pytest.mark.parametrize("seed", range(3))
def test_gains_are_found(seed):
    """Half a stop between cameras is found to 3 %, and corrected images agree."""
    batch = painted_batch(2)
    gains = sample_gains(batch, seed)
    dark = seen_with(batch, gains)
    found = log_gains(surface_splats(dark), dark)
    assert np.abs(np.log(gains)).max() > 0.1
    np.testing.assert_allclose(found, np.log(gains), atol=0.03)
    before, after = (
        (x.images - batch.images).abs().mean() for x in (dark, equalize(surface_splats(dark), dark)[1])
    )
    assert after < 0.2 * before


def test_differences_below_the_error_of_the_estimate_are_left():
    """Half a percent between cameras may as well be an error of depths."""
    batch = painted_batch()
    found = log_gains(surface_splats(batch), seen_with(batch, np.exp(sample_gains(batch, stops=0.02) - 1)))
    assert 0 < found.abs().max() < 1e-3


def test_highlights_do_not_decide():
    """In one camera, a third of the surface is twice as dark as in all others."""
    batch = painted_batch()
    gains = sample_gains(batch)
    dark = seen_with(batch, gains)
    images = dark.images.clone()
    first, last = dark.masks[0, 0].nonzero()[:, 1].float().quantile(torch.tensor([0.3, 0.6])).int()
    images[:, 0, :, :, first:last] *= 0.5
    found = log_gains(surface_splats(dark), dataclasses.replace(dark, images=images))
    np.testing.assert_allclose(found, np.log(gains), atol=0.03)


def test_what_a_view_does_not_see_does_not_count():
    """Cameras all around a surface that is slightly darker in front than behind."""
    batch = painted_batch(views=6, spread=360.0, paint=halves)
    gains = sample_gains(batch)
    dark = seen_with(batch, gains)
    np.testing.assert_allclose(log_gains(surface_splats(dark), dark), np.log(gains), atol=0.02)


def test_dark_rims_do_not_count():
    """Half-covered pixels at the outline of a narrow board are darker in one view than their matte
    implies."""
    sharp = painted_batch(views=3, spread=20.0, radii=torch.tensor([0.1, 0.8, 0.01]))
    soft = with_soft_rims(sharp)
    soft = dataclasses.replace(soft, images=sharp.images * soft.alpha[:, :, None])
    gains = sample_gains(soft)
    dark = seen_with(soft, gains)
    images = dark.images.clone()
    images[:, 0] *= torch.where(dark.alpha[:, 0] < 0.9, 0.8, 1.0)[:, None]
    found = log_gains(surface_splats(soft), dataclasses.replace(dark, images=images))
    np.testing.assert_allclose(found, np.log(gains), atol=0.03)


@pytest.mark.parametrize("kind", ["white", "black"])
def test_colours_without_a_ratio_do_not_count(kind):
    """Clipped highlights, and shadows at a sensor's black level, cover most of the surface."""
    value = {"white": 0.97, "black": 0.01}[kind]
    batch = painted_batch(paint=lambda p: torch.where(p[..., 1:2] > 1.1, 0.4, value).expand(p.shape))
    gains = sample_gains(batch)
    dark = seen_with(batch, gains)
    level = torch.tensor([0.0025 * (kind == "black"), 0, 0, 0])[:, None, None, None]
    images = (dark.images + level).clamp(max=1) * batch.masks[:, :, None]
    found = log_gains(surface_splats(batch), dataclasses.replace(dark, images=images))
    np.testing.assert_allclose(found, np.log(gains), atol=0.03)


def test_batch_mates_change_nothing():
    both = painted_batch(2)
    dark = seen_with(both, sample_gains(both))
    together = log_gains(surface_splats(dark), dark)
    for b in range(2):
        parts = {name: getattr(dark, name)[[b]] for name in ("images", "masks", "cameras", "depths")}
        alone = dataclasses.replace(dark, **parts)
        torch.testing.assert_close(
            log_gains(surface_splats(alone), alone), together[[b]], atol=1e-5, rtol=1e-4
        )


@pytest.mark.parametrize("value", [0.0, 1.0])
def test_photographs_that_say_nothing_have_no_gains(value):
    """Entirely black or white images, and no Gaussians at all."""
    batch = painted_batch()
    flat = dataclasses.replace(batch, images=torch.full_like(batch.images, value))
    assert not log_gains(surface_splats(flat), flat).any()
    nothing = surface_splats(batch).select(slice(0, 0), (0,))
    assert not log_gains(nothing, batch).any()


def test_photographs_that_are_divided_already_are_not_equalized_again():
    """The prediction equals, bit for bit, that of a model without the option, also for a subset of views."""
    batch = painted_batch()
    dark, logs = seen_with(batch, sample_gains(batch)), torch.zeros(1, 4, 3)
    logs[0, 1], logs[0, 3] = 0.1, -2.0
    known = divide_by_gains(dark, logs)
    torch.testing.assert_close(known.images[0, 1], dark.images[0, 1] * math.exp(-0.1))
    assert torch.equal(known.images[0, 2], dark.images[0, 2])
    torch.testing.assert_close(known.images[0, 3], (dark.images[0, 3] * math.exp(2)).clamp(max=1))
    plain, equal = (
        make_model("model=recurrent", "skip=exact", f"rounds.gains={on}").eval() for on in ("false", "true")
    )
    with torch.no_grad():
        for views in (range(4), (3, 1, 2)):
            some = known.of_views(views)
            assert torch.equal(some.log_gains, logs[:, list(views)])
            without = dataclasses.replace(some, log_gains=None)
            expected, found = plain(without).gaussians.colors, equal(some).gaussians.colors
            assert torch.equal(found, expected)
            assert not torch.equal(equal(without).gaussians.colors, expected)


@pytest.mark.parametrize("gamma", [0.8, 1.2])
@pytest.mark.parametrize("view", range(4))
def test_the_gamma_of_each_camera_is_found(view, gamma):
    """In all channels and at any exposure; the others have none."""
    batch = painted_batch(2)
    gains = sample_gains(batch)
    images = (0.6 * batch.images * torch.as_tensor(gains)[..., None, None].float()).clone()
    images[1, view] **= gamma
    wrong = dataclasses.replace(batch, images=images)
    expected = torch.zeros(2, 4, 3)
    expected[1, view] = math.log(gamma)
    torch.testing.assert_close(log_gammas(surface_splats(wrong), wrong), expected, atol=0.04, rtol=0)
