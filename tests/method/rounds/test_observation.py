"""Samples of images and renders at the positions of Gaussians."""

import dataclasses
import math

import pytest
import torch

from ghgs_lit.geometry.masks import coverage, on_black
from ghgs_lit.geometry.projection import project
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.method.rounds.observation import SLOPES, observe, sample_maps, slopes
from ghgs_lit.ops.observation import CHANNELS
from ghgs_lit.rendering import render
from ghgs_lit.types import Batch
from tests.helpers.scenes import make_batch, surface_splats, with_soft_rims


@pytest.mark.parametrize("size", [(56, 56), (42, 84)])
def test_a_gaussian_sees_itself_in_its_own_view(size):
    """Its colour equals the image's, inside the mask and not occluded."""
    batch = make_batch(2, 3, *size)
    gaussians = surface_splats(batch)
    each = observe(gaussians, batch)
    assert each.shape == (len(gaussians), 3, CHANNELS)
    own = each[:, 0]
    assert own[:, :3].abs().max() < 1e-3  # the image's colour is its own
    assert (own[:, 6] - 1).abs().max() < 1e-3  # inside the mask
    assert (own[:, 9] == 1).all()
    assert torch.equal(each[..., 10], torch.tensor([1.0, 0, 0]).expand(len(each), 3))


def test_what_lies_behind_the_surface_is_hidden():
    """Against the true depths at the pixels that Gaussians project to."""
    batch = make_batch(1, 4)
    gaussians = surface_splats(batch)
    each = observe(gaussians, batch)[..., 8]
    for view in range(4):
        # The own view is the first; the others follow in their order.
        behind = each.gather(1, ((view - gaussians.image) % 4)[:, None])[:, 0]
        camera = batch.cameras[0, view]
        pixels, z = project(gaussians.means, camera.intrinsics, camera.extrinsics)
        column, row = pixels.long().clamp(0, 55).unbind(-1)
        surface = batch.depths[0, view, row, column]
        hidden = (surface > 0) & (z - surface > 0.15)
        assert hidden.sum() > 50
        assert (behind[hidden] > 0.9).all()
        own = gaussians.image == view
        assert behind[own].abs().mean() < 0.3


@pytest.mark.parametrize("means", [torch.tensor([[0.1, 0.9, 50.0]]), torch.tensor([[1e6, 0.0, 0.0]])])
def test_outside_of_all_images_everything_is_0(means):
    batch = make_batch(1, 2)
    one = surface_splats(batch).select(slice(0, 1), (1,))
    each = observe(dataclasses.replace(one, means=means), batch)
    assert each.isfinite().all()
    assert not each[each[..., 9] == 0][:, :9].any()


def test_photographs_are_compared_with_renders_where_both_are_premultiplied():
    """Gaussians have the subject's colours and the matte as opacity; the matte replaces the mask."""
    batch = with_soft_rims(make_batch(1, 2))
    plain = observe(surface_splats(batch), dataclasses.replace(batch, alpha=None))
    each = observe(surface_splats(batch), batch)
    assert torch.equal(each[..., :6], plain[..., :6])
    between = [((found[..., 6] > 0.05) & (found[..., 6] < 0.95)).sum() for found in (each, plain)]
    assert between[0] > between[1]


def test_errors_are_the_photograph_minus_the_render():
    """Splats that are too dark have positive errors, those of their own pixel."""
    batch = make_batch(1, 3)
    dark = surface_splats(batch)
    dark = dataclasses.replace(dark, colors=0.5 * dark.colors)
    error = batch.images - render(dark, batch.cameras).image
    expected = error.flatten(0, 1).flatten(2).mT[dark.image, dark.pixel]
    each = observe(dark, batch)
    assert expected.mean() > 0.05
    torch.testing.assert_close(each[:, 0, 3:6], expected, rtol=0, atol=1e-3)
    torch.testing.assert_close(each[:, 0, :3], dark.colors, rtol=0, atol=1e-3)


def slanted(batch):
    """Splats that do not fit: shifted, of three sizes, half transparent."""
    gaussians = surface_splats(batch)
    generator = torch.Generator().manual_seed(3)
    moved = 0.01 * torch.randn(gaussians.means.shape, generator=generator)
    sizes = 0.01 * (1 + torch.rand(gaussians.scales.shape, generator=generator))
    turns = torch.randn(gaussians.quaternions.shape, generator=generator)
    return dataclasses.replace(
        gaussians,
        means=gaussians.means + moved,
        scales=sizes,
        quaternions=turns / turns.norm(dim=-1, keepdim=True),
        opacities=gaussians.opacities / 2,
    )


def test_slopes_say_by_how_much_the_error_changes():
    """Against finite differences of the rendered error with respect to means along rays, scales,
    opacities and colours."""
    batch = make_batch(1, 3, 28, 28)
    gaussians = slanted(batch)
    n = len(gaussians)
    rays = torch.nn.functional.normalize(
        torch.randn(n, 3, generator=torch.Generator().manual_seed(5)), dim=-1
    )
    footprints = torch.full((n, 1), 0.02)
    drawn, steep = slopes(gaussians, batch, 3 * rays, footprints)
    torch.testing.assert_close(drawn.image, render(gaussians, batch.cameras).image)
    assert steep.shape == (n, SLOPES)
    assert not steep.requires_grad
    steep = torch.atanh(steep.double()) / 4

    def error(**changes):
        shown = render(dataclasses.replace(gaussians, **changes), batch.cameras)
        wrong = (shown.image - on_black(batch)).double().square().sum()
        return (wrong + (shown.alpha - coverage(batch)[:, :, None]).double().square().sum()) / 2

    def rise(step, change):
        """Finite difference of the error."""
        return (error(**change(step)) - error(**change(-step))) / (2 * step)

    logits = gaussians.opacities.logit()
    along = rise(1e-3, lambda t: {"means": gaussians.means + t * 0.02 * rays})
    wider = rise(1e-3, lambda t: {"scales": gaussians.scales * math.exp(t)})
    opaque = rise(1e-3, lambda t: {"opacities": (logits + t).sigmoid()})
    brighter = rise(1e-3, lambda t: {"colors": gaussians.colors + t})
    expected = torch.stack((along, wider, opaque, brighter))
    found = torch.stack((steep[:, 0], *(part.sum(-1) for part in steep[:, 4:].split((3, 1, 3), -1)))).sum(-1)
    torch.testing.assert_close(
        found, expected, rtol=0.1, atol=0.01 * float(expected.abs().max())
    )  # splats are cut off
    # Slopes along a Gaussian's axes add up to that along the ray.
    own = quaternion_to_matrix(gaussians.quaternions).double()
    across = (own @ steep[:, 1:4, None])[..., 0]
    torch.testing.assert_close((across * rays).sum(-1), steep[:, 0], rtol=1e-3, atol=1e-4)


def test_slopes_of_inference_are_those_of_training():
    """Bit for bit, in inference mode and with another element in the batch."""
    batch = make_batch(2, 3, 28, 28)
    gaussians = slanted(batch)
    n = len(gaussians)
    arguments = gaussians, batch, torch.ones(n, 3), torch.full((n, 1), 0.02)
    _, expected = slopes(*arguments)
    with torch.inference_mode():
        _, found = slopes(
            *(value.clone() if isinstance(value, torch.Tensor) else value for value in arguments)
        )
    assert torch.equal(found, expected)
    first = gaussians.select(torch.arange(gaussians.splits[0]), gaussians.splits[:1])
    one = Batch(batch.images[:1], batch.masks[:1], batch.cameras[:1])
    _, alone = slopes(first, one, torch.ones(len(first), 3), torch.full((len(first), 1), 0.02))
    torch.testing.assert_close(alone, expected[: len(first)], rtol=1e-4, atol=1e-6)


def test_elements_of_different_sizes_are_looked_up_as_one_by_one():
    """Elements are padded to the same number of Gaussians; the padding appears in no result, also with an
    empty element."""
    batch = make_batch(3, 3, 42, 56)
    whole = surface_splats(batch)
    first, _, last = (whole[i] for i in range(3))
    few = torch.cat((torch.arange(7), len(first) + len(whole[1]) + torch.arange(len(last))))
    gaussians = whole.select(few, (7, 0, len(last)))
    found = sample_maps(gaussians, batch.cameras, batch.images)
    alone = [sample_maps(gaussians[i], batch.cameras[i : i + 1], batch.images[i : i + 1]) for i in (0, 2)]
    for values, each in zip(found, zip(*alone, strict=True), strict=True):
        assert torch.equal(values, torch.cat(each))
    nothing = sample_maps(gaussians[1], batch.cameras[:1], batch.images[:1])
    assert [tuple(values.shape) for values in nothing] == [(0, 3, 3), (0, 3, 1), (0, 3, 1)]
