"""Baselines on analytic scenes."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from PIL import Image

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.baselines import BASELINES, baseline, nearest_view, splats_at
from ghgs_lit.geometry.projection import project
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch, Rendering, Targets
from tests.helpers.scenes import CENTER, RADII, painted_ellipsoid
from tests.helpers.scenes import ring as ring_around
from tests.helpers.training import Standin, batched, example_batch, flat_renderer, ring


def nothing(gaussians, cameras):
    shape = (*cameras.shape, 1, cameras.height, cameras.width)
    return Rendering(torch.zeros(*cameras.shape, 3, cameras.height, cameras.width), *[torch.zeros(shape)] * 2)


def named(name, renderer):
    return baseline(name, renderer, Standin, 1)


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
        named("true_depth", nothing)(dataclasses.replace(example_batch(), depths=None))
    with pytest.raises(InputError, match="baselines"):
        named("white", nothing)


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
    truth, renderer = painted.targets.images, Renderer(backend="cpu")
    image = named(name, renderer if name != "untrained" else flat_renderer)(painted).image
    assert image.shape == truth.shape == (2, 2, 3, 40, 24)
    if name == "black":
        assert not image.any()
    elif name != "untrained":  # nearer to the truth than to black, and to the other subject's
        error = (image - truth).square().flatten(1).mean(1)
        assert (error < truth.square().flatten(1).mean(1) / 2).all()
        assert (error < (image.flip(0) - truth).square().flatten(1).mean(1)).all()
