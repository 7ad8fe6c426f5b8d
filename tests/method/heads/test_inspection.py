"""The fraction of offsets at their limit, recounted in predictions."""

import math

import lightning.pytorch as L
import pytest
import torch
from torch.utils.data import DataLoader

from ghgs_lit.method.heads.inspection import collect_attributes, offsets_at_limit
from ghgs_lit.training import GHGSModule, Optimization
from tests.helpers.losses import losses_of
from tests.helpers.models import make_model, predict
from tests.helpers.scenes import make_batch
from tests.helpers.training import example_batch, flat_renderer

LIMIT = 0.05


def saturating(batch, *overrides):
    """A model that moves half of a batch's Gaussians to their limit."""
    model = make_model(*overrides).eval()
    with torch.no_grad(), collect_attributes(model.gaussian_head) as seen:
        predict(model, batch)
    last = model.gaussian_head.offset_header[-1]
    middle = seen[-1].offset.abs().amax(-1).median()
    for parameter in (last.weight, last.bias):
        parameter.data.mul_(math.atanh(0.95) / middle)
    return model


def test_the_share_is_that_of_the_gaussians_of_the_prediction():
    """Offsets are recovered from the predicted positions, in world axes."""
    batch = make_batch(2, 3)
    model = saturating(batch, "model=paper", "model.frame=world")
    with torch.no_grad(), collect_attributes(model.gaussian_head) as seen:
        prediction = predict(model, batch)
    gaussians = prediction.gaussians
    points = prediction.points.pixels.flatten(0, 1).flatten(1, 2)[gaussians.image, gaussians.pixel]
    moved = (gaussians.means.double() - points.double()).abs()
    assert moved.max() <= LIMIT * 1.001
    # Float32 resolves positions of some metres to a micrometre, of 47.5 mm.
    sure = ((moved - 0.95 * LIMIT).abs() > 1e-5).all(-1)
    expected = (moved > 0.95 * LIMIT).any(-1)[sure].double().mean()
    assert 0.05 < expected < 0.95
    unsure = float((~sure).double().mean())
    assert offsets_at_limit(seen[-1]).item() == pytest.approx(expected.item(), abs=unsure + 1e-6)
    predict(model, batch)
    assert len(seen) == 1


def test_rounds_are_seen_one_after_another():
    """The last raw attributes, which the rounds have changed, are those of the prediction."""
    model, batch = make_model("model=recurrent").eval(), make_batch(1, 3)
    for parameter in model.rounds.parameters():  # untrained rounds change nothing
        parameter.data.add_(0.01)
    with torch.no_grad(), collect_attributes(model.gaussian_head) as seen:
        prediction = predict(model, batch)
    assert len(seen) == 3
    assert not torch.equal(seen[0].offset, seen[-1].offset)
    assert len(seen[-1].offset) == len(prediction.gaussians)


@pytest.mark.parametrize("limit", [LIMIT, None])
def test_validation_logs_it_where_there_is_a_limit(limit, tmp_path):
    """Without a limit, nothing is logged."""
    batches = [example_batch(1, size=28), example_batch(1, size=28, seed=1)]
    model = saturating(
        batches[0], "model=paper", f"gaussian_head.offset_limit={'null' if limit is None else limit}"
    )
    losses = losses_of({"render_l1": 1.0})
    module = GHGSModule(model, flat_renderer, losses, Optimization(lr=0.1, warmup=0.1, end_factor=0.0))
    trainer = L.Trainer(
        accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, default_root_dir=tmp_path,
    )  # fmt: skip
    (numbers,) = trainer.validate(
        module, DataLoader(batches, batch_size=None, collate_fn=lambda b: b), verbose=False
    )
    assert ("val/offsets_at_limit" in numbers) is (limit is not None)
    if limit is not None:
        shares = []
        for batch in batches:
            with torch.no_grad(), collect_attributes(model.gaussian_head) as seen:
                predict(model, batch)
            shares.append(offsets_at_limit(seen[-1]).item())
        assert numbers["val/offsets_at_limit"] == pytest.approx(sum(shares) / 2, abs=1e-6)
        assert 0 < sum(shares) < 2
