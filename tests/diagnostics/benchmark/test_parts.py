"""The parts of a benchmark: order, errors, FLOPs, memory, scenes."""

import dataclasses
import math

import pytest
import torch
import torch.nn.functional as F

from ghgs_lit.cli.benchmark import broken_budgets, make_rows
from ghgs_lit.diagnostics.benchmark import measure
from ghgs_lit.diagnostics.benchmark.cases import Case, combinations
from ghgs_lit.diagnostics.benchmark.measure import (
    ATTRIBUTES,
    MOST,
    NAMES,
    OTHER,
    ROUNDS,
    TOTAL,
    Record,
    SecondsProbe,
    amplification,
    conditioned_difference,
    differences,
    flop_counter,
    forward,
    match_gaussians,
    relative_difference,
    time_cases,
    top_level,
    watch_model,
)
from ghgs_lit.diagnostics.benchmark.scene import ellipse, ellipsoid_batch
from ghgs_lit.errors import InputError
from ghgs_lit.execution import Predictor
from ghgs_lit.rendering import Renderer
from tests.helpers.models import close, make_model

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def scene():
    return ellipsoid_batch(share=0.2, views=3, size=42, batch=1)


@pytest.fixture(scope="module")
def model():
    return Predictor(make_model().eval())


@pytest.fixture(scope="module")
def probe():
    return SecondsProbe(CPU)


@pytest.fixture(scope="module")
def result(model, scene, probe):
    """Prediction and render, with their times in the probe."""
    return forward(model, Renderer(), scene, probe)


def case(model, name, renderer):
    return Case(name, model, renderer, None, None, False)


def test_cases_are_interleaved_and_warm_up_rounds_do_not_count(model, scene, monkeypatch):
    """Every round runs all cases once and begins with another one."""
    seen, a, b = [], Renderer(), Renderer()

    def noted(model, renderer, batch, probe=None):
        seen.append("a" if renderer is a else "b")
        return forward(model, renderer, batch, probe)

    monkeypatch.setattr(measure, "forward", noted)
    records = [Record(case(model, "a", a)), Record(case(model, "b", b))]
    time_cases(records, [scene, scene], warmup=1, repeats=2, device=CPU)
    assert "".join(seen) == "bbaa" + "aabb" + "bbaa"
    for record in records:
        assert list(record.seconds) == [name for name in NAMES if name != ROUNDS]
        assert {len(seconds) for seconds in record.seconds.values()} == {2}


def test_differences_are_the_worst_of_the_batches(model):
    """A mean would hide a subject that a preset spoils."""
    names = ("max_rel_diff", "rel_diff", "mse_to_none", "psnr_to_none", "unmatched")
    batches = [
        dict(zip(names, values, strict=True)) for values in ((0.1, 2, 1e-4, 40, 0), (0.3, 1, 1e-3, 30, 0.2))
    ]
    about = {"method": "model", "views": 3, "targets": "release", "subject": "a", "psnr": 30.0}
    costs = [{"peak_bytes": 1.0}, {"peak_bytes": 3.0}]
    record = Record(case(model, "none", Renderer()), costs, batches, [about], {TOTAL: [1.0]})
    (row,) = make_rows([record])
    assert row["differences"] == dict(zip(names, (0.3, 2, 1e-3, 30, 0.2), strict=True))
    assert row["peak_bytes"] == 3


def test_stages_and_the_rest_add_up_to_the_total(result, probe):
    """Time outside of all stages is not lost."""
    seconds = probe.seconds()
    assert list(seconds) == [name for name in NAMES if name != ROUNDS]
    assert sum(seconds[name] for name in top_level(seconds)) + seconds[OTHER] == pytest.approx(seconds[TOTAL])
    assert 0 < seconds["encoder.patch_tokens"] < seconds["encoder"] < seconds[TOTAL]
    assert seconds[OTHER] >= 0


def test_a_probe_leaves_the_model_and_its_prediction_as_they_were(model, scene, result):
    """Hooks are removed after a measurement, and do not change the prediction."""
    bounds = model.model.bounds
    with torch.no_grad():  # as in the measurement: kernels round otherwise than PyTorch
        close(result[0].gaussians, model(scene).gaussians, 0)
    with watch_model(model.model, SecondsProbe(CPU)):
        assert model.model.bounds is not bounds
        assert model.model.bounds.samples == bounds.samples
    assert model.model.bounds is bounds
    assert not any(m._forward_hooks or m._forward_pre_hooks for m in model.model.modules())


ONE = torch.ones(2)
MANY = torch.ones(300)
MANY[:3] = torch.tensor([9.0, 3.0, 5.0])  # as of decisions within rounding; a defect changes more values


@pytest.mark.parametrize(
    ("found", "expected", "share", "difference"),
    [
        (ONE * 3, ONE * 2, 1, 0.5),
        (ONE[:0], ONE[:0], 1, 0),
        (ONE * 0, ONE * 0, 1, 0),
        (ONE, ONE * 0, 1, math.inf),
        (ONE * math.nan, ONE, 1, math.inf),
        (MANY, torch.ones(300), 1, 8),
        (MANY, torch.ones(300), MOST, 0),
        (torch.where(torch.arange(300) == 3, 1.5, MANY), torch.ones(300), MOST, 0.5),
        (torch.where(torch.arange(300) == 4, math.nan, MANY), torch.ones(300), MOST, math.inf),
    ],
)
def test_relative_differences_are_always_defined(found, expected, share, difference):
    """An empty or broken result must not pass a budget as NaN. Budgets ignore one value of a hundred."""
    assert relative_difference(found, expected, share) == difference


KEPT = {
    "preset": "fast", "trained": True, "psnr_loss_db": 0.01, "budget_db": 0.02, "difference_db": 0.01,
    "max_rel_diff_budget": 1e-5, "rel_diff": 1e-6, "differences": {"unmatched": 0.0},
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "broken"),
    [
        ({}, []),
        ({"psnr_loss_db": 0.03}, ["a loss"]),
        ({"psnr_loss_db": math.nan, "max_rel_diff_budget": None}, ["a loss"]),
        ({"psnr_loss_db": 0.03, "trained": False}, []),
        ({"difference_db": 0.03}, ["a loss"]),
        ({"difference_db": 0.03, "max_rel_diff_budget": None}, []),
        ({"rel_diff": math.nan}, ["rel_diff"]),
        ({"differences": {"unmatched": 0.1}}, ["the Gaussians"]),
    ],
)
def test_budgets(change, broken):
    """A preset with ``max_rel_diff`` must also keep ``difference_db`` within its budget."""
    lines = broken_budgets({**KEPT, **change})
    assert len(lines) == len(broken)
    assert all(line.startswith(f"expected {text}") for line, text in zip(lines, broken, strict=True))


def test_the_condition_is_what_a_rounding_of_the_images_changes(model, scene, result, monkeypatch):
    """A depth that changes 64 times as much as the images has a condition of 64, a constant one of 1."""
    place = scene.images.argmax()

    def moved(model, renderer, batch):
        change = (batch.images.flatten()[place] / scene.images.flatten()[place]).log().item()
        prediction, rendering = result
        return dataclasses.replace(prediction, depth=prediction.depth * (1 + 64 * change)), rendering

    monkeypatch.setattr(measure, "forward", moved)
    found = amplification(case(model, "none", Renderer()), scene, result)
    # The brightest pixel is below 1: its rounding is between half of eps and eps.
    assert 30 < found["depth"] < 66
    assert all(found[name] == 1 for name in (*ATTRIBUTES, "render"))
    twice = [dataclasses.replace(result[0], depth=result[0].depth * (1 + factor)) for factor in (1e-3, 2e-3)]
    first, second = (conditioned_difference((one, result[1]), result, scene, found) for one in twice)
    assert first == pytest.approx(1e-3 / found["depth"], rel=0.1)
    assert second == pytest.approx(2 * first, rel=1e-3)


def test_gaussians_are_compared_by_their_pixel(scene, result):
    """A preset that drops some Gaussians, or orders them otherwise, is compared on the others."""
    gaussians = result[0].gaussians
    kept = torch.arange(len(gaussians)).flip(0)[: len(gaussians) // 2]
    found = dataclasses.replace(result[0], gaussians=gaussians.select(kept, (len(kept),)))
    a, b = match_gaussians(found.gaussians, gaussians)
    assert torch.equal(kept[a], b)
    changes = differences((found, result[1]), result, scene.masks)
    assert all(changes[name] == 0 for name in (*ATTRIBUTES, "render", "depth", "max_rel_diff"))
    assert changes["unmatched"] == pytest.approx(0.5, abs=1 / len(gaussians))
    assert changes["psnr_to_none"] == pytest.approx(100)
    nothing = gaussians.select(kept[:0], (0,))
    assert [len(index) for index in match_gaussians(nothing, gaussians)] == [0, 0]
    assert [len(index) for index in match_gaussians(gaussians, nothing)] == [0, 0]


@pytest.mark.parametrize(
    ("run", "flops"),
    [
        (lambda: F.linear(torch.rand(5, 7), torch.rand(3, 7)), 2 * 5 * 7 * 3),
        (lambda: F.scaled_dot_product_attention(*[torch.rand(1, 2, 32, 16)] * 3), 4 * 2 * 32 * 32 * 16),
        (lambda: torch.ops.ghgs_lit.attend(*[torch.rand(1, 2, 8, 32)] * 3, None), 4 * 2 * 8 * 8 * 32),
    ],
)
def test_flops_of_products_and_attention(run, flops):
    """PyTorch counts neither attention on a CPU nor the compiled kernel."""
    with torch.no_grad(), flop_counter() as counter:
        run()
    assert counter.get_total_flops() == flops


@pytest.mark.parametrize("share", [0.05, 0.15, 0.6])
def test_the_subject_covers_the_given_part_of_the_frame(share):
    """The mask has this share in every view, for any aspect of the frame."""
    for size in ((280, 280), (420, 280), (210, 280)):
        assert ellipse(share, size).float().mean().item() == pytest.approx(share, rel=0.02)
    batch = ellipsoid_batch(share, 3, 56, 2)
    assert batch.masks.float().mean((-2, -1)).sub(share).abs().max() < 0.02
    assert batch.images.shape == (2, 3, 3, 56, 56)
    with pytest.raises(InputError, match="share"):
        ellipse(0.75, (56, 56))


def test_knobs_are_combined_and_checked():
    """Every combination is a case; an unknown key is named."""
    both = combinations({"recalibration.k": [4, 8], "precision": ["float32"]})
    assert both == [
        {"recalibration.k": 4, "precision": "float32"},
        {"recalibration.k": 8, "precision": "float32"},
    ]
    assert combinations({}) == [{}]
    for knobs in ({"trainer.max_steps": [1]}, {"recalibration.k": 4}, {"recalibration.k": []}):
        with pytest.raises(InputError, match=r"knobs\."):
            combinations(knobs)
