"""The cases of ``ghgs stress quick=true``: every stage on every family, without a failure."""

import pytest

from ghgs_lit.cli.stress import tasks_of
from ghgs_lit.diagnostics.stress.measure import measure
from ghgs_lit.diagnostics.stress.whole import STAGES


@pytest.mark.parametrize("stage", STAGES)
def test_no_case_fails(stage):
    rows = [row for task in tasks_of([stage], quick=True) for row in measure(*task)]
    failed = [(r["family"], r["dtype"], r["error"], r["worst"]) for r in rows if r["failures"]]
    assert rows
    assert not failed
