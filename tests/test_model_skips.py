"""Work that the model skips: the same Gaussians of the same pixels at lower cost."""

import dataclasses
import operator

import pytest
import torch

from tests.helpers.models import close, make_model, predict
from tests.helpers.scenes import make_batch


def test_skip_fast_gives_the_gaussians_of_skip_exact_where_nothing_is_background():
    """The preset changes only the tokens of the encoder."""
    batch = make_batch(2, 3)
    batch = dataclasses.replace(batch, masks=torch.ones_like(batch.masks))
    with torch.no_grad():
        fast, exact = (predict(make_model(f"skip={skip}"), batch).gaussians for skip in ("fast", "exact"))
    close(fast, exact)


def test_only_windows_around_the_subject_are_decoded():
    """skip=exact skips this work, except where all tokens require a depth."""
    batch = make_batch(2, 3, zoom=0.4)
    batch.masks[1, 0] = False
    model = make_model("skip=exact")
    decoded = []
    for head in (model.depth_head.dpt, model.gaussian_head.decoder):
        head.register_forward_hook(lambda _, args, maps: decoded.append((len(maps), *maps.shape[2:])))
    predict(model, batch)
    assert [count for count, *_ in decoded] == [3, 2, 3, 2]
    assert all(max(size) < 56 for _, *size in decoded)
    decoded.clear()
    model.recalibration.tokens = "all"
    predict(model, batch)
    assert decoded == [(6, 56, 56), *decoded[1:]]
    assert [count for count, *_ in decoded[1:]] == [3, 2]


@pytest.mark.parametrize(
    "overrides", [["model=hull"], ["unprojection.tokens=release"]], ids=operator.itemgetter(0)
)
@pytest.mark.parametrize("size", [(70, 70), (154, 98)])
def test_skip_exact_gives_the_gaussians_of_skip_none(size, overrides):
    """skip=exact promises the same Gaussians, also where windows are smaller than the images."""
    batch = make_batch(2, 3, *size, zoom=0.3)
    batch.masks[0, 1] = False
    batch.masks[1, 2, :5, -9:] = True
    with torch.no_grad():
        exact, none = (
            predict(make_model(f"skip={skip}", *overrides), batch).gaussians for skip in ("exact", "none")
        )
    close(exact, none)


@pytest.mark.parametrize("size", [(56, 56), (42, 70)])
def test_tokens_of_windows_give_gaussians_of_the_same_pixels(size):
    """The encoder receives less background; the geometry is that of the whole images."""
    batch = make_batch(2, 3, *size, zoom=0.5)
    whole, part = (predict(make_model(f"skip={name}"), batch) for name in ("exact", "balanced"))
    assert len(part.points.tokens) < len(whole.points.tokens)
    assert part.depth.shape == whole.depth.shape
    assert torch.equal(part.depth_valid, batch.masks)
    for name in ("image", "pixel", "colors"):
        assert torch.equal(getattr(part.gaussians, name), getattr(whole.gaussians, name)), name
    assert part.gaussians.splits == whole.gaussians.splits
    for name in ("near", "far"):
        near = (getattr(prediction.depth_maps.bounds, name)[batch.masks] for prediction in (part, whole))
        assert torch.equal(*near)
