"""Refinement brings renders nearer to the images, improves other views, and stays within its bounds."""

import dataclasses

import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.baselines import splats_at
from ghgs_lit.geometry.projection import world_to_camera
from ghgs_lit.metrics.functional import psnr
from ghgs_lit.metrics.regions import box_of
from ghgs_lit.refinement import Refinement
from ghgs_lit.refinement.refinement import _footprints
from ghgs_lit.rendering import Renderer
from ghgs_lit.types import Batch
from tests.helpers.scenes import painted_ellipsoid, ring

RENDERER = Renderer(backend="cpu")


def scene(batch=1, views=4, size=56):
    """Images, dull and thin splats at the true depth, and a view between the inputs."""
    around = ring(batch, 2 * views, size, size)
    images, masks, _ = painted_ellipsoid(around[:, ::2])
    inputs = Batch(images, masks, around[:, ::2])
    return at_true_depth(inputs), inputs, around[:, 1:2]


def at_true_depth(batch):
    """A stand-in for a prediction: dull and thin splats at the true depth for all given inputs."""
    splats = splats_at(batch, painted_ellipsoid(batch.cameras)[2], batch.masks, sigma=0.25)
    return dataclasses.replace(splats, colors=0.95 * splats.colors)


def quality(gaussians, cameras, images, masks=None):
    """PSNR, in the masks' boxes if there are masks."""
    region = None if masks is None else box_of(masks.flatten(0, 1))
    return float(psnr(RENDERER(gaussians, cameras).image.flatten(0, 1), images.flatten(0, 1), region).mean())


def test_a_view_that_nobody_saw_gets_better():
    """A view that is not an input improves, as the inputs do."""
    splats, inputs, between = scene()
    target = painted_ellipsoid(between)[0]
    refinement = Refinement(15, RENDERER)
    refined = refinement(splats, inputs)
    assert quality(refined, between, target) > quality(splats, between, target) + 2
    before, after = (quality(g, inputs.cameras, inputs.images, inputs.masks) for g in (splats, refined))
    assert after > before + 2


def test_changes_are_bounded():
    """Parts that no image shows stay near the prediction, however long the refinement."""
    splats, inputs, _ = scene(size=42)
    splats.opacities[:2] = torch.tensor((0.0, 1.0))  # a step of their infinite logits could not change these
    noise = dataclasses.replace(inputs, images=torch.rand(inputs.images.shape) * inputs.masks[:, :, None])
    refined = Refinement(70, RENDERER)(splats, noise)
    depth = world_to_camera(splats.means, inputs.cameras.extrinsics[0][splats.image])[:, 2]
    footprint = (depth / inputs.cameras.intrinsics[0, 0, 0, 0])[:, None]
    moved = (refined.means - splats.means).abs() / footprint
    assert 0.5 < moved.max() <= 1.001
    assert 0.5 < (refined.scales / splats.scales).log().abs().max() <= 1.001
    assert 0.03 < (refined.colors - splats.colors).abs().max() <= 0.0501
    assert ((refined.opacities > 0) & (refined.opacities < 1)).all()
    assert torch.equal(refined.quaternions, splats.quaternions)


def test_some_photographs_of_a_batch_are_a_batch():
    """Selecting views selects everything that belongs to them."""
    _, inputs, _ = scene(size=28)
    names = dataclasses.replace(inputs, alpha=inputs.masks.float(), views=(("a", "b", "c", "d"),))
    part = names.of_views([2, 0])
    assert part.views == (("c", "a"),)
    assert torch.equal(part.alpha, names.alpha[:, [2, 0]])
    assert torch.equal(part.cameras.extrinsics, names.cameras.extrinsics[:, [2, 0]])
    assert part.depths is None


def test_what_is_beside_the_subject_takes_no_part():
    """Images may contain their background; those with a matte are premultiplied by it, on black."""
    splats, inputs, _ = scene(size=42)
    room = dataclasses.replace(inputs, images=torch.where(inputs.masks[:, :, None], inputs.images, 0.7))
    matte = dataclasses.replace(inputs, alpha=inputs.masks.float())
    expected, *found = (Refinement(3, RENDERER)(splats, batch) for batch in (inputs, room, matte))
    for refined in found:
        assert torch.equal(refined.means, expected.means)
        assert torch.equal(refined.colors, expected.colors)


def test_elements_are_refined_as_if_alone():
    """The result does not depend on batch mates."""
    splats, inputs, _ = scene(batch=2, size=28)
    together = Refinement(6, RENDERER)(splats, inputs)
    assert together.splits == splats.splits
    for b in range(2):
        one = Batch(inputs.images[b : b + 1], inputs.masks[b : b + 1], inputs.cameras[b : b + 1])
        alone = Refinement(6, RENDERER)(dataclasses.replace(splats[b], image=splats[b].image - 4 * b), one)
        for name in ("means", "scales", "opacities", "colors"):
            torch.testing.assert_close(getattr(alone, name), getattr(together[b], name), rtol=1e-4, atol=1e-5)


def test_what_cannot_be_refined_is_refused():
    """Splats from a file have no pixels in these images."""
    splats, inputs, _ = scene(size=28)
    with pytest.raises(InputError, match="refine: expected Gaussians of the inputs' pixels"):
        Refinement(1, RENDERER)(dataclasses.replace(splats, image=None), inputs)
    with pytest.raises(InputError, match="refine: expected 1 or more steps"):
        Refinement(0, RENDERER)


def test_silhouettes_alone_make_what_is_too_thin_denser():
    """For a black subject on black, colours say nothing, but the silhouette determines opacity."""
    splats, inputs, _ = scene(size=28)
    black = dataclasses.replace(inputs, images=torch.zeros_like(inputs.images))
    thin = dataclasses.replace(
        splats, colors=torch.zeros_like(splats.colors), opacities=torch.full_like(splats.opacities, 0.3)
    )
    refined = Refinement(5, RENDERER)(thin, black)
    assert (refined.opacities > thin.opacities + 0.01).float().mean() > 0.75


def test_footprints_are_of_each_photographs_own_mean_focal_length():
    """One view has a longer focal length along one axis."""
    splats, inputs, _ = scene(size=28)
    lenses = inputs.cameras.intrinsics.clone()
    lenses[0, 1, 0, 0] *= 4
    longer = dataclasses.replace(inputs, cameras=dataclasses.replace(inputs.cameras, intrinsics=lenses))
    expected = torch.where(splats.image[:, None] == 1, 0.5, 1.0) * _footprints(splats, inputs)
    torch.testing.assert_close(_footprints(splats, longer), expected)
