"""Numbers of rows rounded up to shape buckets, as on a GPU, change results only by rounding."""

import pytest
import torch

from ghgs_lit.extents import bucket_size
from ghgs_lit.method.plan import make_plan, plan
from ghgs_lit.method.plan.rows import Rows
from ghgs_lit.rendering import render
from tests.helpers.losses import losses_of
from tests.helpers.models import close, make_model, predict
from tests.helpers.scenes import hard_subjects, make_batch, stack, training_batch

#: With a fraction of the tokens as neighbours, their number differs between elements of a batch.
KINDS = [("model=paper",), ("model=hull", "recalibration.k=0.3"), ("model=recurrent", "recalibration.k=0.3")]
TWO_ROUNDS = ["rounds.training_counts=[2]"]
PRESETS = ["none", "exact", "balanced", "fast"]
WEIGHTS = {"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 0.01, "depth": 0.5}


pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def rounding(monkeypatch):
    """Turns shape buckets on and off."""

    def switch(on):
        monkeypatch.setattr(plan, "rounds_up", lambda device: on)

    return switch


def test_shape_buckets_add_an_eighth_at_most_and_are_few():
    """Every bucket holds its count; of 100,000 counts there are about eight per octave."""
    classes = [bucket_size(count) for count in range(1, 100_001)]
    assert all(count <= size <= count * 9 / 8 for count, size in enumerate(classes, start=1))
    assert len(set(classes)) == 117
    assert classes == sorted(classes)


def test_filled_rows_repeat_a_row_that_counts():
    """Against a loop; a group without valid rows repeats its first pixel."""
    wanted = torch.rand(4, 50, generator=torch.Generator().manual_seed(0)) < 0.4
    wanted[2] = False
    size = bucket_size(int(wanted.sum(1).max()))
    rows = Rows.filled(wanted, size, 1)
    assert rows.counts == (size,) * 4
    for group, (index, real) in enumerate(zip(rows.index.view(4, -1), rows.real.view(4, -1), strict=True)):
        own = (50 * group + wanted[group].nonzero()[:, 0]).tolist()
        last = own[-1] if own else 50 * group
        assert index.tolist() == own + [last] * (size - len(own))
        assert real.tolist() == [True] * len(own) + [False] * (size - len(own))
    counts, number = rows.places(200)
    assert torch.equal(counts, wanted.flatten())
    assert torch.equal(rows.index[number[counts]], wanted.flatten().nonzero()[:, 0])


def test_shapes_repeat_where_subjects_differ_a_little():
    """Images of another instant have the same shapes, as a captured graph requires."""
    masks = make_batch(2, 3, 112, 112).masks
    other = masks & (torch.rand(masks.shape, generator=torch.Generator().manual_seed(0)) < 0.995)
    counted = [make_plan(each, 14, kept_of(each), in_buckets=False) for each in (masks, other)]
    rounded = [make_plan(each, 14, kept_of(each), in_buckets=True) for each in (masks, other)]
    assert counted[0].subject.counts != counted[1].subject.counts
    assert rounded[0].subject.counts == rounded[1].subject.counts
    assert rounded[0].peers.counts == rounded[1].peers.counts
    assert rounded[0].windows == rounded[1].windows
    for window, hull in zip(counted[0].windows, rounded[0].windows, strict=True):
        assert hull.hull(window) == hull


def kept_of(masks):
    """All patches of 14 pixels."""
    return torch.ones(*masks.shape[:2], masks.shape[2] // 14, masks.shape[3] // 14, dtype=torch.bool)


@torch.no_grad()
@pytest.mark.parametrize("skip", PRESETS)
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind[0])
def test_predictions_are_the_same(kind, skip, rounding):
    """For subjects of very different sizes in one batch, one of them a single pixel."""
    model, batch = make_model(*kind, f"skip={skip}").eval(), stack(list(hard_subjects().values()))
    rounding(False)
    expected = predict(model, batch)
    rounding(True)
    filled = model.plan(batch)
    assert filled.subject.real is not None
    assert not filled.subject.real.all()
    found = predict(model, batch)
    assert found.gaussians.splits == expected.gaussians.splits
    assert torch.equal(found.gaussians.pixel, expected.gaussians.pixel)
    close(found.gaussians, expected.gaussians)
    torch.testing.assert_close(found.depth[batch.masks], expected.depth[batch.masks], rtol=0, atol=2e-6)


@pytest.mark.parametrize("kind", [*KINDS, ("model=hull", "skip=fast")], ids=str)
def test_gradients_are_the_same(kind, rounding):
    """A repeated row must not be counted twice."""
    model, batch, found = (
        make_model(*kind, *TWO_ROUNDS * ("model=recurrent" in kind)).train(),
        training_batch(2, 56),
        [],
    )
    for on in (False, True):
        rounding(on)
        model.zero_grad()
        prediction = predict(model, batch)
        rendering = render(prediction.gaussians, batch.targets.cameras)
        loss = losses_of(WEIGHTS)(prediction, rendering, batch)[0]
        loss.backward()
        slopes = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}
        found.append((loss.detach(), slopes))
    (loss, slopes), (filled_loss, filled) = found
    torch.testing.assert_close(filled_loss, loss)
    assert slopes.keys() == filled.keys()
    for name, slope in slopes.items():
        assert (filled[name] - slope).norm() <= 1e-4 * slope.norm() + 1e-9, name


@torch.no_grad()
def test_a_pixel_without_a_finite_depth_is_transparent(rounding):
    """A CPU drops it; with fixed sizes its Gaussian has opacity 0."""
    model, batch = make_model("model=hull").eval(), stack(list(hard_subjects().values())[:2])
    head = model.depth_head.forward

    def spoil(*inputs):
        maps = head(*inputs)
        maps.valid[0, 0, 28] = False
        return maps

    model.depth_head.forward = spoil
    missing = int(batch.masks[0, 0, 28].sum())
    rounding(False)
    exact = predict(model, batch).gaussians
    rounding(True)
    filled = predict(model, batch).gaussians
    assert len(filled) == len(exact) + missing == int(batch.masks.sum())
    shown = filled.opacities > 0
    assert int((~shown).sum()) == missing
    close(filled.select(shown, exact.splits), exact)
