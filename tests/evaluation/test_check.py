"""The requirements of the end of a run are checked before its first step."""

import shutil

import pytest

from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import run_of
from ghgs_lit.data.reader import Photographs
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.report import check_evaluation


def check(root, *overrides):
    """Check the evaluation of a training run."""
    said = ["data=scans", f"data.root={root}", "data.size=42", *overrides]
    run = run_of("train", said)
    check_evaluation(run, build_data(run))


@pytest.mark.parametrize(
    ("said", "refused"),
    [
        ("evaluation.split=foo", "evaluation.split: expected one of train, val; found 'foo'"),
        ("evaluation.targets=[foo]", "evaluation.targets: expected one of cameras, .*; found 'foo'"),
        ("evaluation.targets=[]", "evaluation.targets: expected a list with a value"),
        ("evaluation.views=[0]", r"evaluation.views: expected an integer >= 2 .*; found \[0\]"),
        ("evaluation.views=[1]", "evaluation.views: expected an integer >= 2"),
        ("evaluation.views=[4,4]", "evaluation.views: expected different numbers from 2 on"),
        ("evaluation.views=[4.5]", "evaluation.views: expected an integer >= 2"),
        (
            "evaluation.views=[17]",
            "with 17 views: expected different positions of a ring of 16; found 17",
        ),
        ("evaluation.pictures=-1", "evaluation.pictures: expected an integer >= 0"),
        ("targets.per_subject=9", "targets.per_subject: expected at most the 4 inputs"),
        ("metrics.lpips=sometimes", "lpips"),
    ],
)
def test_an_impossible_evaluation_is_refused_before_a_photograph_is_read(boxes, monkeypatch, said, refused):
    """A run of days must not end without results because of a value that was wrong from the start."""
    monkeypatch.setattr(Photographs, "view", lambda *_: pytest.fail("a photograph was read"))
    check(boxes)
    with pytest.raises(InputError, match=refused):
        check(boxes, said)


def test_photographs_that_targets_lack_are_named(boxes, tmp_path):
    """A protocol may require views that were never rendered, or a camera that one person lacks."""
    root = tmp_path / "rendered"
    shutil.copytree(boxes, root)
    for path in (root / "val" / "img").glob("*/3.jpg"):
        path.unlink()
    said = r"evaluation.targets=release: expected view 3 of subject s3 at position 0; found \[0, 2, 4\]"
    with pytest.raises(InputError, match=said):
        check(root)
    check(root, "targets=ghg", "evaluation.targets=[ghg]")
