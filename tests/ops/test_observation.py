"""CPU and GPU kernels of the observations of Gaussians, compared with plain PyTorch in float64."""

import dataclasses

import pytest
import torch

from ghgs_lit.method.rounds.observation import observe
from ghgs_lit.rendering import render
from ghgs_lit.types import map_tensors
from tests.helpers.kernels import WHERE, kernels
from tests.helpers.scenes import make_batch, surface_splats, with_soft_rims

EPS = torch.finfo(torch.float32).eps


def in_float64(value):
    return map_tensors(value, lambda x: x.double() if x.is_floating_point() else x)


def on_device(kind, *values):
    return [map_tensors(value, lambda x: x.to(WHERE[kind])) for value in values]


@pytest.mark.parametrize("kind", WHERE)
@pytest.mark.parametrize(("b", "v", "height", "width"), [(2, 4, 28, 42), (1, 2, 56, 28), (3, 5, 42, 28)])
@pytest.mark.parametrize("spread", [0.0, 0.3, 3.0])
@pytest.mark.parametrize("is_soft", [False, True])
def test_values_are_as_exact_as_plain_pytorchs(kind, b, v, height, width, spread, is_soft):
    """Cases cover elements with unequal numbers of Gaussians or none, Gaussians outside frames and behind
    cameras, and an image without a subject."""
    batch = make_batch(b, v, height, width)
    batch = with_soft_rims(batch) if is_soft else batch
    batch.masks[-1, 0] = False
    gaussians = surface_splats(make_batch(b, v, height, width))
    noise = torch.randn(gaussians.means.shape, generator=torch.Generator().manual_seed(1))
    gaussians = dataclasses.replace(gaussians, means=gaussians.means + spread * noise)
    if b > 1:
        first = gaussians.splits[0]
        keep = torch.cat((torch.arange(7), first + torch.arange(sum(gaussians.splits[1:-1]))))
        gaussians = gaussians.select(keep, (7, *gaussians.splits[1:-1], 0))
    rendering = render(gaussians, batch.cameras)
    gaussians, batch, rendering = on_device(kind, gaussians, batch, rendering)
    exact = observe(*map(in_float64, (gaussians, batch, rendering)))
    with kernels(kind) as called:
        found = observe(gaussians, batch, rendering)
    assert called == ["observe"]
    # A pixel coordinate is a quotient of products, exact to some roundings of its size: colours differ by
    # that fraction of the largest difference of neighbouring pixels. A distance behind the surface is
    # divided by 5 cm.
    pixel = 8 * EPS * max(height, width)
    assert (exact[..., 9] == 0).any() == (spread > 0.2)
    same = (found[..., 9] == exact[..., 9].float()).all(-1)
    assert same.float().mean() > 0.995  # rounding may move a point across a border
    difference = (found - exact).abs()[same]
    assert difference[:, :, :8].max() < 8 * pixel
    steepest = rendering.depth.abs().max() / 0.05
    assert difference[:, :, 8].max() < 8 * pixel * steepest
    assert torch.equal(found[..., 10], exact[..., 10].float())


@pytest.mark.parametrize("kind", WHERE)
def test_nothing_in_a_batch_of_none_and_what_is_not_finite_stays_where_it_is(kind):
    batch = make_batch(2, 3, 28, 28)
    gaussians = surface_splats(batch)
    rendering = render(gaussians, batch.cameras)
    gaussians, batch, rendering = on_device(kind, gaussians, batch, rendering)
    means, images = gaussians.means.clone(), batch.images.clone()
    means[4], images[1, 2] = torch.nan, torch.nan
    spoiled = dataclasses.replace(gaussians, means=means), dataclasses.replace(batch, images=images)
    with kernels(kind):
        expected = observe(gaussians, batch, rendering)
        found = observe(*spoiled, rendering)
        none = observe(gaussians.select(slice(0, 0), (0, 0)), batch, rendering)
    first = gaussians.splits[0]
    assert none.shape == (0, 3, 11)
    assert not found[4, :, :10].any()
    assert torch.equal(found[5:first], expected[5:first])
    assert found[first:, :, 6:].isfinite().all()
