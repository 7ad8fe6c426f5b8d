"""Mattes: premultiplied photographs and the colours behind them."""

import dataclasses

import torch

from ghgs_lit.geometry.masks import coverage, surface_colors, with_matte
from tests.helpers.scenes import make_batch


def matted():
    """Photographs of known colours, premultiplied by shares that include 0 and 1."""
    batch = make_batch(2, 3)
    generator = torch.Generator().manual_seed(2)
    colors, share = (
        torch.rand(shape, generator=generator) for shape in (batch.images.shape, batch.masks.shape)
    )
    share = torch.where(share < 0.2, 0, torch.where(share > 0.8, 1, share))
    images = colors * share[:, :, None]
    return colors, dataclasses.replace(batch, images=images, alpha=share, masks=share >= 0.5)


def test_colors_are_those_before_premultiplication():
    """Where nothing of the subject shows, the photograph stays;
    noise of a file gives no colour above 1."""
    colors, batch = matted()
    shown = (batch.alpha > 0)[:, :, None]
    found = surface_colors(batch)
    torch.testing.assert_close(found, torch.where(shown, colors, batch.images))
    noisy = surface_colors(dataclasses.replace(batch, images=batch.images + 4 / 255))
    assert noisy.isfinite().all()
    assert torch.where(shown, noisy, 0).max() <= 1
    half = dataclasses.replace(batch, images=batch.images.bfloat16(), alpha=batch.alpha.bfloat16())
    assert surface_colors(half).dtype == torch.float32


def test_without_a_matte_nothing_changes():
    """Binary masks lose nothing: the very photographs, and masks as shares."""
    _, batch = matted()
    plain = dataclasses.replace(batch, alpha=None)
    assert surface_colors(plain) is plain.images
    assert torch.equal(coverage(plain), plain.masks.float())
    assert torch.equal(coverage(batch), batch.alpha)
    assert with_matte(plain, 0.1) is plain


def test_masks_grow_to_what_shows_enough_of_the_subject():
    """None leaves the matte out."""
    _, batch = matted()
    grown = with_matte(batch, 0.125)
    assert torch.equal(grown.masks, batch.alpha > 0.125)
    assert grown.alpha is batch.alpha
    left_out = with_matte(batch, None)
    assert left_out.alpha is None
    assert torch.equal(left_out.masks, batch.masks)
