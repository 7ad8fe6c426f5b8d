"""Results of measuring a method: rows, depth errors, seconds, values that are not finite."""

import dataclasses

import pytest
import torch

from ghgs_lit.evaluation.measure import Estimate, ModelMethod, measure, not_finite
from ghgs_lit.execution import Predictor
from ghgs_lit.method.recalibration import Recalibration
from ghgs_lit.metrics import MetricsOptions, psnr
from ghgs_lit.rendering import render
from ghgs_lit.types import Targets
from tests.helpers.models import make_model, predict
from tests.helpers.scenes import make_batch
from tests.helpers.training import Standin, example_batch, flat_renderer

OFF = MetricsOptions(lpips="off").build()


def test_rows_say_what_they_are_about_and_hold_the_metrics(tmp_path):
    """Every number has its subject, target and inputs, and the value of the metric."""
    batch = example_batch(subjects=2, views=3, targets=2)
    rows = measure(ModelMethod(Standin(), flat_renderer), "model", [batch], OFF, "cpu", tmp_path, 1)
    assert [(r["subject"], r["target"]) for r in rows] == [
        ("p0", "000/3"), ("p0", "001/3"), ("p1", "000/3"), ("p1", "001/3"),
    ]  # fmt: skip
    assert {(r["method"], r["views"], r["targets"]) for r in rows} == {("model", 3, "midway")}
    assert rows[0]["inputs"] == ["000/0", "001/0", "002/0"]
    image = flat_renderer(Standin()(batch).gaussians, batch.targets.cameras).image
    expected = psnr(image[1, 1][None].clamp(0, 1), batch.targets.images[1, 1][None]).item()
    assert rows[3]["psnr"] == pytest.approx(expected)
    inside = batch.targets.masks[1, 1].nonzero()
    (top, left), (bottom, right) = inside.amin(0).tolist(), inside.amax(0).tolist()
    pair = (picture[1, 1, :, top : bottom + 1, left : right + 1] for picture in (image, batch.targets.images))
    expected = psnr(*(part[None].clamp(0, 1) for part in pair)).item()
    assert rows[3]["psnr_box"] == pytest.approx(expected, abs=1e-4) != rows[3]["psnr"]
    # the stand-in predicts 2.5 m, the truth is 2.1 m
    assert rows[0]["depth_error_mm"] == pytest.approx(400, abs=1e-2)
    assert rows[0]["gaussians"] == 144
    assert rows[0]["surface_mm"] > 100
    assert [p.name for p in tmp_path.iterdir()] == ["model_v3_midway_p0.png"]


def test_what_is_not_finite_is_counted_and_named():
    """Neither renderers nor depth errors include it."""
    batch = dataclasses.replace(make_batch(2, 3), subjects=("anna", "ben"))
    with torch.no_grad():
        prediction = predict(make_model("model=hull").eval(), batch)
    assert not_finite(batch, prediction) == (0, 0)
    prediction.gaussians.scales[-2:, 0] = torch.nan
    prediction.depth_valid[1][batch.masks[1]] &= torch.arange(int(batch.masks[1].sum())) > 2
    with pytest.warns(UserWarning, match="not finite: ben: 5"):
        assert not_finite(batch, prediction) == (0, 5)


@pytest.mark.parametrize("model", ["model=hull", "model=paper", "model=recurrent"])
def test_a_model_without_any_finite_depth_is_measured(model):
    """One broken subject must not lose the metrics of all others."""
    broken, batch = make_model(model).eval(), make_batch(1, 3)
    batch = dataclasses.replace(batch, subjects=("anna",), targets=example_batch(subjects=1).targets)
    for parameter in broken.depth_head.parameters():
        parameter.data.fill_(torch.nan)
    with pytest.warns(UserWarning, match="not finite: anna: "):
        [row, *_] = measure(ModelMethod(Predictor(broken), render), "model", [batch], OFF)
    assert row["gaussians"] == 0
    assert row["psnr"] > 0
    assert row["not_finite"] == int(batch.masks.sum())


def test_what_refines_takes_part_in_what_is_measured():
    """Refined Gaussians and corrected cameras must not be omitted silently."""
    batch = example_batch()
    given = flat_renderer(Standin()(batch).gaussians, batch.targets.cameras).image

    def halved(gaussians, batch):
        return dataclasses.replace(gaussians, colors=gaussians.colors / 2)

    def darker(batch):
        return dataclasses.replace(batch, images=batch.images / 4)

    for refinement, cameras, share in ((halved, None, 2), (None, darker, 4), (halved, darker, 8)):
        method = ModelMethod(Standin(), flat_renderer, refinement, cameras)
        with torch.no_grad():
            estimate = method(batch)
        torch.testing.assert_close(estimate.image, given / share)
        # Refined Gaussians are not at the predicted depths.
        assert (estimate.depth is None) == (refinement is not None)


def test_depth_errors_are_those_of_the_subject():
    """Depths outside the subject are arbitrary."""
    batch = example_batch(subjects=2)
    depth = torch.where(batch.masks, 2.1, 9.0)
    batch = dataclasses.replace(batch, depths=torch.full_like(depth, 2.1))
    valid = torch.ones_like(batch.masks)
    estimate = Estimate(batch.targets.images, depth + 0.02, valid)
    rows = measure(lambda b: estimate, "model", [batch], OFF)
    assert [row["depth_error_mm"] for row in rows] == pytest.approx([20, 20], abs=1e-2)


def test_seconds_are_those_of_a_subject(monkeypatch):
    """A batch of two that takes six seconds takes three for each."""
    ticks = iter([10.0, 16.0])
    monkeypatch.setattr("ghgs_lit.evaluation.measure.time.perf_counter", lambda: next(ticks))
    rows = measure(lambda b: Estimate(b.targets.images), "model", [example_batch(subjects=2)], OFF)
    assert [row["seconds"] for row in rows] == [3, 3]


def test_what_is_timed_searches_no_neighbors_of_the_other_setting(monkeypatch):
    """Measured seconds exclude the share of neighbours that an ablation keeps, which is computed later."""
    searched, positions = [], Recalibration.positions
    monkeypatch.setattr(
        Recalibration,
        "positions",
        lambda stage, *args: searched.append(stage.neighborhood) or positions(stage, *args),
    )
    batch = make_batch(1, 3)
    own = Targets(batch.images[:, :1], batch.masks[:, :1], batch.cameras[:, :1], (("a",),), ("midway",))
    batch = dataclasses.replace(batch, targets=own, subjects=("p0",))
    method = ModelMethod(Predictor(make_model("model=paper").eval()), render)
    with torch.no_grad():
        method(batch)
    assert searched == ["xyz"]
    (row,) = measure(method, "model", [batch], OFF)
    assert searched[1:] == ["xyz", "xyz", "image_plane"]
    assert 0 < row["shared_neighbors"] <= 1
