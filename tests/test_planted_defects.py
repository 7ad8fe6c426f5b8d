"""The list of planted defects: each can still be planted, and names a test that exists."""

from benchmarks.planted_defects import ROOT, defects


def test_every_defect_can_be_planted():
    """What it changes stands in the packages exactly once, and what must notice it is there."""
    problems = []
    for defect in defects():
        try:
            defect.planted((ROOT / defect.file).read_text())
            assert defect.test_id
        except ValueError as error:
            problems.append(f"{defect.at} ({defect.what}): {error}")
    assert not problems, "\n".join(problems)
