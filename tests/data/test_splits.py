"""Splits into train and val: drawn, read from files, given as ids and ranges, refused."""

import pytest

from ghgs_lit.data.splits import read_split, split_names
from tests.helpers.captures import refused

NAMES = [f"s{i}" for i in range(10)]


def test_a_share_of_the_scans_is_drawn(tmp_path):
    """By the seed, where neither files nor lists decide."""
    drawn = split_names(tmp_path, NAMES, None, 0.2, 0)
    assert sorted(drawn["train"] + drawn["val"]) == NAMES
    assert len(drawn["val"]) == 2
    assert drawn == split_names(tmp_path, NAMES, None, 0.2, 0)
    assert drawn != split_names(tmp_path, NAMES, None, 0.2, 1)


@pytest.fixture
def folders(tmp_path):
    """Folders of split files: with both, without the second, with one id in both."""
    for name, val in (("both", "s3\n"), ("one", None), ("twice", "s2\n")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "split_train.txt").write_text("s1\ns2\n")
        if val:
            (tmp_path / name / "split_val.txt").write_text(val)
    return tmp_path


def test_files_and_lists_decide(folders):
    """Files beside the scans before a draw; what is configured before both."""
    listed = {"train": ["s4"], "val": ["s5"]}
    for split, expected in ((None, {"train": ["s1", "s2"], "val": ["s3"]}), (listed, listed)):
        assert split_names(folders / "both", NAMES, split, 0.2, 0) == expected


@pytest.mark.parametrize(
    ("split", "line"),
    [
        ("one", r"split_val\.txt: expected one id a line; found no such file"),
        ("twice", "expected disjoint train and val; found 's2' in both"),
        ("none", r"none: expected a folder with split_train\.txt .*; found no such"),
        ({"train": ["s4"], "val": ["zz"]}, r"expected ids of scans in .*; found 'zz' in val"),
        ({"train": ["s0-s2"], "val": ["s2"]}, r"data\.split: expected disjoint .* found 's2' in both"),
        ({"train": ["s0"]}, r"data\.split: expected a list 'val'"),
    ],
)
def test_bad_splits_are_refused(folders, split, line):
    split = str(folders / split) if isinstance(split, str) else split
    refused(line, lambda: split_names(folders, NAMES, split, 0.2, 0))


def test_ranges_of_ids():
    """Ranges select among the ids that exist."""
    names = [f"{i:04d}" for i in range(0, 526, 25)]
    split = read_split({"train": ["0000-0425"], "val": ["0426-0525"]}, names)
    assert (len(split["train"]), len(split["val"])) == (18, 4)


@pytest.mark.parametrize(
    ("count", "fraction", "measured"), [(1, 0.1, 1), (2, 0.1, 1), (4, 0.1, 1), (4, 0.0, 0), (2, 1, 2)]
)
def test_few_scans_leave_somebody_to_validate(tmp_path, count, fraction, measured):
    """A tenth of four scans is one; all can be measured, or none."""
    names = [f"s{i}" for i in range(count)]
    drawn = split_names(tmp_path, names, None, fraction, 0)
    assert len(drawn["val"]) == measured
    assert sorted(drawn["train"] + drawn["val"]) == names
