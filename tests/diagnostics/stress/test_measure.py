"""The stress test: its cells are complete, and it detects defects of stages."""

import dataclasses
import json
from collections import Counter

import pytest
import torch
from torch.utils.data import default_collate

from ghgs_lit.cli.stress import tasks_of
from ghgs_lit.diagnostics.stress.families import FAMILIES
from ghgs_lit.diagnostics.stress.measure import DTYPES, PLANTED, condition, evaluate, measure
from ghgs_lit.diagnostics.stress.whole import STAGES
from tests.helpers.verbs import ghgs


def test_the_full_run_is_large_and_no_stage_dominates():
    """At least twenty seeds in each cell; no stage has more than a fifth of the cases."""
    cases = Counter()
    for stage, _, seeds in tasks_of():
        assert seeds >= 20
        cases[stage.name] += seeds * len(DTYPES)
    assert sum(cases.values()) >= 50_000
    assert max(cases.values()) <= sum(cases.values()) / 5
    known = {family.ingredient for family in FAMILIES.values()} - {None}
    assert known == {ingredient for stage in STAGES.values() for ingredient in stage.ingredients}


@pytest.mark.parametrize("family", list(PLANTED))
def test_a_value_without_effect_is_found(family):
    """A stage whose outputs are finite although an input is not fails, unless it has a reason."""
    stage = STAGES["unit vectors"]
    hide = dataclasses.replace(stage, run=lambda v: {"unit": stage.run(v)["unit"].nan_to_num()}, gradients=())
    assert measure(hide, family, 3, ["float32"])[0]["failures"] == 3


def test_a_value_that_reaches_another_case_is_found():
    """A mean over cases spreads a value that is not finite."""
    stage = STAGES["unit vectors"]
    mix = dataclasses.replace(
        stage, run=lambda v: {"unit": stage.run(v)["unit"] + v["vectors"].mean(0)}, gradients=()
    )
    assert measure(mix, next(iter(PLANTED)), 3, ["float32"])[0]["failures"] == 3


def test_the_condition_of_a_case_does_not_depend_on_others():
    """A reported seed reproduces its figure alone, up to float64 roundings over the step of 1e-7."""
    stage = STAGES["unit vectors"]
    cases = default_collate(
        [stage.make("ordinary", torch.Generator().manual_seed(seed)) for seed in range(3)]
    )
    exact = {name: value.double() for name, value in cases.items()}
    last = {name: value[2:] for name, value in exact.items()}
    conditions = [condition(stage, inputs, evaluate(stage, inputs, "float64")[0]) for inputs in (exact, last)]
    for name, values in conditions[1].items():
        torch.testing.assert_close(conditions[0][name][2:], values, rtol=1e-6, atol=0)


def test_a_stage_that_raises_is_a_failure(monkeypatch, capsys, tmp_path):
    """It is reported in one line for each dtype, and the other stages are measured."""
    broken = dataclasses.replace(STAGES["cosine"], run=lambda v: {"cosines": v + 1})
    monkeypatch.setitem(STAGES, "cosine", broken)
    settings = ("quick=true", f"hydra.run.dir={tmp_path}")
    assert ghgs("stress", "stages=[cosine,unit vectors]", *settings) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ghgs stress: ")]
    assert [line.partition(": expected")[0] for line in lines] == [
        f"ghgs stress: cosine, {family}, {dtype}" for family in broken.families for dtype in DTYPES
    ]
    assert all("TypeError" in line for line in lines)
    cells = json.loads((tmp_path / "stress.json").read_text())["cells"]
    failures = {(cell["stage"], cell["failures"]) for cell in cells}
    assert failures == {("cosine", 3), ("unit vectors", 0)}


def test_a_mask_on_the_result_instead_of_the_argument_is_found():
    """The gradient of such a stage is NaN."""

    def masked(v):
        direction = v["vectors"] / v["vectors"].norm(dim=-1, keepdim=True)
        return {"unit": torch.where(v["vectors"].abs().sum(-1, keepdim=True) > 0, direction, 0.0)}

    broken = dataclasses.replace(STAGES["unit vectors"], run=masked)
    assert measure(broken, "zero_quaternion", 3, ["float32"])[0]["failures"] == 3
