"""The stress test itself: its matrix is complete, and it catches what it must catch."""

import dataclasses
import json
from collections import Counter

import pytest
import torch

from ghgs_lit.diagnostics.stress.measure import measure
from ghgs_lit.diagnostics.stress.run import Task, run_tasks, tasks_of
from ghgs_lit.diagnostics.stress.stage import DTYPES, FAMILIES, PLANTED
from ghgs_lit.diagnostics.stress.stages import STAGES
from tests.helpers.verbs import ghgs


def failures(name, family, run, dtype="float32"):
    """Failures of a stage whose function is replaced by ``run``."""
    stage = STAGES[name]
    reference = stage.reference or stage.run
    broken = dataclasses.replace(stage, run=run, reference=reference)
    return sum(row["failures"] for row in measure(broken, family, range(3), [dtype]))


def test_the_full_run_is_large_and_no_stage_dominates():
    """A hundred thousand cases, at least twenty seeds in each cell, no stage more than a fifth."""
    cases = Counter()
    for task in tasks_of():
        assert task.seeds >= 20
        cases[task.stage] += task.seeds * len(STAGES[task.stage].dtypes)
    assert sum(cases.values()) >= 100_000
    assert max(cases.values()) <= sum(cases.values()) / 5
    known = {family.ingredient for family in FAMILIES.values()} - {None}
    assert known == {ingredient for stage in STAGES.values() for ingredient in stage.ingredients}


def _plain_direction(v):
    squared = v["vectors"].square().sum(-1, keepdim=True)
    return {"unit": v["vectors"] * squared.rsqrt()}


def _masked_result(v):
    direction = v["vectors"] / v["vectors"].norm(dim=-1, keepdim=True)
    return {"unit": torch.where(v["vectors"].abs().sum(-1, keepdim=True) > 0, direction, 0.0)}


def _half_precision_distances(v):
    found = STAGES["cosine"].run(v)
    return {"cosines": found["cosines"].half().to(found["cosines"].dtype)}


@pytest.mark.parametrize(
    ("stage", "family", "defect"),
    [
        ("unit vectors", "huge_quaternion", _plain_direction),
        ("unit vectors", "tiny_quaternion", _plain_direction),
        ("unit vectors", "zero_quaternion", _masked_result),
        ("cosine", "ordinary", _half_precision_distances),
    ],
)
def test_a_planted_defect_is_caught(stage, family, defect):
    """Squares that overflow, a mask on the result instead of the argument, a value in float16."""
    assert failures(stage, family, STAGES[stage].run) == 0
    assert failures(stage, family, defect) > 0


@pytest.mark.parametrize("family", list(PLANTED))
def test_a_value_that_vanishes_is_caught(family):
    """A stage that hides NaN or infinity must say why."""
    stage = STAGES["unit vectors"]
    hide = dataclasses.replace(stage, run=lambda v: {"unit": stage.run(v)["unit"].nan_to_num()}, gradients=())
    assert measure(hide, family, range(3), ["float32"])[0]["failures"] == 3


def test_a_run_in_other_processes_has_the_same_rows():
    """Cases depend on stage, family and seed alone."""
    tasks = [Task("unit vectors", family, 2) for family in ("ordinary", "zero_quaternion")]
    alone, beside = ([{**row, "seconds": 0} for row in run_tasks(tasks, n)] for n in (0, 1))
    assert alone == beside


def test_a_stage_that_raises_is_a_failure(monkeypatch, capsys, tmp_path):
    """In one line, and the other stages are measured."""
    broken = dataclasses.replace(STAGES["cosine"], run=lambda v: {"cosines": v + 1})
    monkeypatch.setitem(STAGES, "cosine", broken)
    settings = ("quick=true", "workers=0", f"hydra.run.dir={tmp_path}")
    assert ghgs("stress", "stages=[cosine,unit vectors]", "families=[ordinary]", *settings) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("ghgs stress: ")]
    assert [line.partition(": expected")[0] for line in lines] == [
        f"ghgs stress: cosine, ordinary, {dtype}" for dtype in DTYPES
    ]
    assert all("TypeError" in line for line in lines)
    cells = json.loads((tmp_path / "stress.json").read_text())["cells"]
    assert [(cell["stage"], cell["failures"]) for cell in cells[::4]] == [("cosine", 3), ("unit vectors", 0)]
