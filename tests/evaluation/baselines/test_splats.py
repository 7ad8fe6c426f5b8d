"""Splats at a depth that is not learned."""

import torch

from ghgs_lit.evaluation.baselines.splats import splats_at
from tests.helpers.scenes import make_batch, with_soft_rims


def test_splats_have_the_surfaces_own_colors():
    """A photograph with a matte is darker at the rim than the surface is; the splats are not."""
    batch = with_soft_rims(make_batch(1, 2))
    valid = batch.masks & (batch.depths > 0)
    found = splats_at(batch, batch.depths, valid).colors
    share = batch.alpha[valid][:, None]
    expected = (batch.images.movedim(2, -1)[valid] / share).clamp(max=1)
    assert (share < 0.9).sum() > 20
    torch.testing.assert_close(found, expected)
