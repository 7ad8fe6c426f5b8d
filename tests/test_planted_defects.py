"""The list of planted defects: each can still be planted, and names tests that exist."""

from pathlib import Path

import pytest

from benchmarks.planted_defects import defects

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("defect", defects(), ids=lambda defect: f"{defect.file}: {defect.says}")
def test_every_defect_can_be_planted(defect):
    """Its text stands in the package exactly once, and what must notice it is there."""
    text = (ROOT / "ghgs_lit" / defect.file).read_text()
    assert defect.planted(text) != text
    assert bool(defect.tests) != bool(defect.stage)
    for test in defect.tests:
        path, _, name = test.partition("::")
        assert f"def {name.partition('[')[0]}" in (ROOT / path).read_text(), test
