"""The whole model on images of any size, and with soft mattes."""

import dataclasses

import pytest
import torch
from torch import nn

from ghgs_lit.errors import InputError
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.geometry.projection import pixel_centers, project
from ghgs_lit.method.bounds import SubjectBox
from ghgs_lit.types import Batch, DepthBounds
from tests.helpers.models import ATTRIBUTES, close, make_model, predict
from tests.helpers.scenes import make_batch, with_soft_rims

PADS = ["model.pad=multiple"]


@pytest.mark.parametrize("skip", ["none", "exact", "balanced", "fast"])
@pytest.mark.parametrize(("size", "name"), [((50, 64), "hull"), ((45, 71), "paper")])
def test_photographs_of_any_size_are_padded_and_come_back(size, name, skip):
    """Stages receive a batch with a black border; results are in pixels of the original images."""
    batch = make_batch(2, 3, *size)
    overrides = [f"model={name}", f"skip={skip}"]
    with pytest.raises(InputError, match=r"model\.pad=multiple"):
        predict(make_model(*overrides), batch)
    found = predict(make_model(*overrides, *PADS), batch)
    assert found.depth.shape == found.depth_maps.confidence.shape == batch.masks.shape
    assert found.points.pixels.shape == (*batch.masks.shape, 3)
    assert torch.equal(found.depth_valid, batch.masks)
    gaussians = found.gaussians
    image, pixel = batch.masks.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
    assert torch.equal(gaussians.image, image)
    assert torch.equal(gaussians.pixel, pixel)
    colors = batch.images.flatten(0, 1).flatten(2).transpose(1, 2)[image, pixel]
    assert torch.equal(gaussians.colors, colors)
    # Points lie on the rays of their pixels, with the cameras of the original images.
    matrices = (m[:, :, None, None] for m in (batch.cameras.intrinsics, batch.cameras.extrinsics))
    uv, z = project(found.points.pixels, *matrices)
    centers = pixel_centers(*size, uv).expand_as(uv)
    assert torch.allclose(uv[batch.masks], centers[batch.masks], atol=1e-3)
    assert torch.allclose(z[batch.masks], found.depth[batch.masks], atol=1e-4)


def test_padding_is_what_a_black_border_does_by_hand():
    """model.pad gives exactly the result for manually padded images."""
    batch = make_batch(1, 3, 50, 64)
    border = nn.functional.pad(batch.images, (3, 3, 3, 3))
    masks = nn.functional.pad(batch.masks, (3, 3, 3, 3))
    by_hand = Batch(border, masks, batch.cameras.crop(-3, -3, 56, 70))
    model = make_model("model=paper", *PADS)
    found = predict(model, batch)
    # The box is carved from the unpadded images: with a border, nothing would lie outside them.
    bounds = model.bounds(Frame.of(batch).enter(batch))
    near, far = (nn.functional.pad(bound, (3, 3, 3, 3), value=1.0) for bound in (bounds.near, bounds.far))
    model.bounds = lambda _: DepthBounds(near, far)
    expected = predict(model, by_hand)
    model.bounds = SubjectBox()
    close(found.gaussians, expected.gaussians, 1e-6)
    torch.testing.assert_close(found.depth, expected.depth[..., 3:-3, 3:-3], rtol=1e-6, atol=0)
    torch.testing.assert_close(found.points.tokens, expected.points.tokens, rtol=0, atol=2e-6)
    assert predict(model, make_batch(1, 3, 56, 70)).depth.shape[-2:] == (56, 70)


def test_without_the_option_mattes_are_ignored():
    """model=paper reads only masks."""
    soft = with_soft_rims(make_batch())
    model = make_model("model=paper").eval()
    found, expected = (predict(model, b).gaussians for b in (soft, dataclasses.replace(soft, alpha=None)))
    for name in ATTRIBUTES:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


@pytest.mark.parametrize("kind", ["hull", "recurrent"])
def test_pixels_that_show_a_part_of_the_subject_become_gaussians(kind):
    """Their share limits the opacity; skip=exact and other batch elements change nothing."""
    both = with_soft_rims(make_batch(2, 3))
    options = (f"model={kind}", "model.matte=0.125")
    model = make_model(*options).eval()
    prediction = predict(model, both)
    shown = (both.alpha > 0.125).flatten(0, 1).flatten(1)
    gaussians = prediction.gaussians
    assert torch.equal(torch.stack((gaussians.image, gaussians.pixel), 1), shown.nonzero())
    assert (gaussians.opacities <= both.alpha.flatten(0, 1).flatten(1)[shown]).all()
    assert prediction.depth_valid.sum() == shown.sum() > both.masks.sum()
    close(gaussians, predict(make_model(*options, "skip=none").eval(), both).gaussians, 2e-5)
    part = slice(1, 2)
    alone = dataclasses.replace(
        both,
        images=both.images[part],
        masks=both.masks[part],
        alpha=both.alpha[part],
        cameras=both.cameras[part],
        depths=None,
    )
    close(predict(model, alone).gaussians, gaussians[1], 2e-5)


def test_photographs_of_any_size_keep_their_mattes():
    """The black border of model.pad=multiple is not part of the subject."""
    soft = with_soft_rims(make_batch(1, 2, 50, 60))
    gaussians = predict(
        make_model("model=hull", "model.matte=0.125", "model.pad=multiple").eval(), soft
    ).gaussians
    shown = (soft.alpha > 0.125).flatten(0, 1).flatten(1)
    assert torch.equal(torch.stack((gaussians.image, gaussians.pixel), 1), shown.nonzero())


def test_an_impossible_matte_is_refused():
    """Above 0.5, pixels of the mask would lack Gaussians."""
    with pytest.raises(
        InputError, match=r"model\.matte: expected a number >= 0 and <= 0\.5 or null; found 0\.7"
    ):
        Predictor(make_model("model=hull", "model.matte=0.7"))
