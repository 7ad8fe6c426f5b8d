"""Splits into train and val: drawn, read from files, given as ids and ranges, refused."""

import pytest

from ghgs_lit.data.splits import read_split, split_names
from ghgs_lit.errors import InputError


def test_splits(tmp_path):
    """All sources of a split, their precedence, and what is refused."""
    names = [f"s{i}" for i in range(10)]
    drawn = split_names(tmp_path, names, None, 0.2, 0)
    assert sorted(drawn["train"] + drawn["val"]) == names
    assert len(drawn["val"]) == 2
    assert drawn == split_names(tmp_path, names, None, 0.2, 0)
    assert drawn != split_names(tmp_path, names, None, 0.2, 1)
    (tmp_path / "split_train.txt").write_text("s1\ns2\n")
    with pytest.raises(InputError, match=r"split_val\.txt: expected one id a line; found no such file"):
        split_names(tmp_path, names, str(tmp_path), 0.2, 0)
    (tmp_path / "split_val.txt").write_text("s3\n")
    assert split_names(tmp_path, names, None, 0.2, 0) == {"train": ["s1", "s2"], "val": ["s3"]}
    custom = {"train": ["s4"], "val": ["s5"]}
    assert split_names(tmp_path, names, custom, 0.2, 0) == custom
    with pytest.raises(InputError, match=r"expected ids of scans in .*; found 'zz' in val"):
        split_names(tmp_path, names, {"train": ["s4"], "val": ["zz"]}, 0.2, 0)
    (tmp_path / "split_val.txt").write_text("s2\n")
    with pytest.raises(InputError, match="expected disjoint train and val; found 's2' in both"):
        split_names(tmp_path, names, str(tmp_path), 0.2, 0)
    with pytest.raises(InputError, match=r"none: expected a folder with split_train\.txt .*; found no such"):
        split_names(tmp_path, names, str(tmp_path / "none"), 0.2, 0)


def test_ranges_of_ids():
    """Ranges select among the ids that exist; an id in both phases is refused."""
    names = [f"{i:04d}" for i in range(0, 526, 25)]
    split = read_split({"train": ["0000-0425"], "val": ["0426-0525"]}, names)
    assert (len(split["train"]), len(split["val"])) == (18, 4)
    with pytest.raises(
        InputError, match=r"data\.split: expected disjoint train and val; found '0025' in both"
    ):
        read_split({"train": ["0000-0025"], "val": ["0025"]}, names)
    with pytest.raises(InputError, match=r"data\.split: expected a list 'val'"):
        read_split({"train": ["0000"]}, names)


@pytest.mark.parametrize(
    ("count", "fraction", "measured"), [(1, 0.1, 1), (2, 0.1, 1), (4, 0.1, 1), (4, 0.0, 0), (2, 1, 2)]
)
def test_few_scans_leave_somebody_to_validate(tmp_path, count, fraction, measured):
    """A tenth of four scans is one; all can be measured, or none."""
    names = [f"s{i}" for i in range(count)]
    drawn = split_names(tmp_path, names, None, fraction, 0)
    assert len(drawn["val"]) == measured
    assert sorted(drawn["train"] + drawn["val"]) == names
