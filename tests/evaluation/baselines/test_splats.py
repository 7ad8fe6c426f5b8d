"""Splats at a depth that is not learned."""

import dataclasses

import pytest
import torch

from ghgs_lit.config import run_of
from ghgs_lit.evaluation.baselines.splats import discs_at, splats_at, splatted, true_depth
from ghgs_lit.geometry.masks import with_matte
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.heads.attributes import RawGaussians
from ghgs_lit.metrics import psnr
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, DepthMaps, Points, Targets
from tests.helpers.scenes import make_batch, painted_ellipsoid, ring, with_soft_rims

RENDERER = Renderer(backend="cpu")


def test_splats_have_the_surfaces_own_colors():
    """A photograph with a matte is darker at the rim than the surface is; the splats are not."""
    batch = with_soft_rims(make_batch(1, 2))
    valid = batch.masks & (batch.depths > 0)
    found = splats_at(batch, batch.depths, valid).colors
    share = batch.alpha[valid][:, None]
    expected = (batch.images.movedim(2, -1)[valid] / share).clamp(max=1)
    assert (share < 0.9).sum() > 20
    torch.testing.assert_close(found, expected)


def test_discs_are_those_that_the_recurrent_model_starts_from():
    """The model's own Gaussian head gives them for raw values of 0 at the same points."""
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


def test_discs_draw_the_surface_better_than_round_splats():
    """At twice the size of the inputs, too, and between two of them."""
    inputs, seen = (ring(1, n, 56, 56) for n in (4, 8))
    images, masks, depths = painted_ellipsoid(inputs)
    for cameras in (seen, seen.resized(112, 112)):
        cameras = cameras[:, 1:2]
        truth, inside, _ = painted_ellipsoid(cameras)
        batch = Batch(images, masks, inputs, depths=depths, targets=Targets(truth, inside, cameras))
        splats = RENDERER(splats_at(batch, batch.depths, batch.masks), cameras)
        discs = splatted(batch, true_depth, RENDERER)
        found = [psnr(drawn.image[0], truth[0]).item() for drawn in (splats, discs)]
        assert found[1] > found[0] + 3


def test_pixels_that_show_little_of_the_subject_have_discs_too():
    """Their opacity is the matte: without them outlines would end at half a pixel."""
    batch = with_soft_rims(make_batch(1, 2))
    own = Targets(batch.images[:, :1], batch.masks[:, :1], batch.cameras[:, :1])
    deep = torch.where(batch.depths > 0, batch.depths, 2.0)
    found = splatted(dataclasses.replace(batch, targets=own, depths=deep), true_depth, RENDERER)
    expected = batch.alpha > 0.125
    assert torch.equal(found.depth_valid, expected)
    assert expected.sum() > (batch.masks & expected).sum()


@pytest.mark.parametrize("splatting", [splats_at, discs_at])
def test_sizes_are_of_each_views_own_focal_length(splatting):
    """A lens of one view that is twice as long makes its splats half as wide, and no others."""
    batch = make_batch(2, 3)
    lenses = batch.cameras.intrinsics.clone()
    lenses[1, 2, [0, 1], [0, 1]] *= 2
    longer = dataclasses.replace(batch, cameras=dataclasses.replace(batch.cameras, intrinsics=lenses))
    found, given = (splatting(one, batch.depths, batch.masks) for one in (longer, batch))
    expected = torch.where(found.image == 5, 0.5, 1.0)[:, None] * given.scales
    torch.testing.assert_close(found.scales, expected)
