"""Guides: full-resolution inputs of dense heads and of the encoder."""

import dataclasses

import pytest
import torch

from ghgs_lit.geometry.masks import UNIT, relative_bounds, relative_depth
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.method.encoder import VGGTOptions
from ghgs_lit.method.heads.guide import GuidePyramid, photo_guide
from ghgs_lit.method.plan.window import Window
from ghgs_lit.types import DepthBounds
from tests.helpers.plans import plan_of
from tests.helpers.scenes import make_batch
from tests.method.heads.test_depth import make_head


def make_encoder(**options):
    torch.manual_seed(0)
    return VGGTOptions(
        width=32, heads=2, depth=4, vit={"kind": "stem", "channels": 8}, layers=(0, 1, 2, 3), **options
    ).build()


def test_relative_maps_know_shape_and_not_distance():
    """Moving the subject away from the camera does not change the network's input."""
    batch = make_batch(2, 3)
    bounds = VisualHull()(batch)
    near, far = bounds.near, bounds.far
    maps = relative_bounds(bounds, batch.masks)
    moved = relative_bounds(DepthBounds(near + 5, far + 5), batch.masks)
    assert torch.allclose(maps, moved, atol=1e-4)
    start, length = maps.unbind(2)
    assert torch.allclose(length[batch.masks], ((far - near) / UNIT)[batch.masks])
    middle = (start + length / 2) * batch.masks
    assert middle.sum((-2, -1)).abs().max() < 1e-2
    assert not maps.movedim(2, -1)[~batch.masks].any()


def test_relative_depth_has_no_gradient_and_no_mean():
    """The Gaussian head does not train depth through its guide."""
    depth = make_batch().depths.requires_grad_()
    masks = depth > 0
    maps = relative_depth(depth, masks)
    assert not maps.requires_grad
    assert maps.sum((-2, -1)).abs().max() < 1e-2


def test_an_empty_mask_gives_empty_maps():
    """A view without the subject gives 0, not NaN."""
    masks = torch.zeros(1, 2, 8, 8, dtype=torch.bool)
    depth = torch.rand(1, 2, 8, 8)
    assert not relative_depth(depth, masks).any()
    assert not relative_bounds(DepthBounds(depth, depth + 1), masks).any()


@pytest.mark.parametrize("size", [(28, 42), (35, 21)])
def test_pyramid_halves_twice(size):
    """Odd image sides give maps of the expected sizes."""
    sizes = [size, tuple((n + 1) // 2 for n in size), tuple((n + 3) // 4 for n in size)]
    full, half, quarter = GuidePyramid(6, 16)((torch.rand(2, 6, *size),), tuple(map(Window.whole, sizes)))
    assert full.shape == (2, 8, *sizes[0])
    assert half.shape == (2, 16, *sizes[1])
    assert quarter.shape == (2, 16, *sizes[2])


def test_depth_follows_the_guide():
    """Two batches with the same tokens and different pixels give different depths, except without a guide."""
    batch = make_batch()
    other = dataclasses.replace(batch, images=batch.images.flip(-1))
    tokens = make_encoder()(batch.images, batch.masks)
    for guided in (True, False):
        head = make_head(guide=guided)
        torch.nn.init.normal_(head.dpt.scratch.output_conv2[-1].weight)
        bounds = VisualHull()(batch)
        plan = plan_of(batch.masks, pixels="all")
        found, changed = (head(tokens, each, bounds, plan).depth for each in (batch, other))
        same = torch.equal(found, changed)
        assert same == (not guided)


def test_the_encoder_sees_bounds_where_it_is_told_to():
    """Tokens depend on bounds with encoder.bounds_input."""
    batch = make_batch()
    bounds = VisualHull()(batch)
    encoder = make_encoder(mask_input=True, bounds_input=True)
    tokens = encoder(batch.images, batch.masks, bounds)
    thicker = DepthBounds(bounds.near, bounds.far + 0.1 * bounds.near)
    deeper = encoder(batch.images, batch.masks, thicker)
    assert not torch.allclose(tokens.latent[-1], deeper.latent[-1])


def test_the_guide_shows_mattes_where_there_are_some():
    """Masks would bring back the hard edges that mattes soften."""
    batch = make_batch()
    share = torch.rand(batch.masks.shape, generator=torch.Generator().manual_seed(3))
    assert torch.equal(photo_guide(batch)[1][:, 0], batch.masks.flatten(0, 1).float())
    soft = photo_guide(dataclasses.replace(batch, alpha=share))
    assert torch.equal(soft[1][:, 0], share.flatten(0, 1))
    assert torch.equal(soft[0], batch.images.flatten(0, 1))
