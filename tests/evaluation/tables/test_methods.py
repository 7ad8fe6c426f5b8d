"""Tables of methods: the paper's reported figures, other methods' files, baselines,
our variants."""

import json
import re
import shutil
from pathlib import Path

import pytest

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables import read_others, to_csv, to_markdown
from tests.helpers.tables import body, start_run, tables_of, write_run

EXAMPLE = Path(__file__).parents[3] / "docs" / "example_others.json"


def others_file(folder: Path, rows: list[dict], **changes) -> Path:
    content = {"format": "ghgs_lit.others", "format_version": 1, "method": "GHG", "source": "their code"}
    path = folder / "others.json"
    path.write_text(json.dumps({**content, "rows": rows, **changes}))
    return path


def a_row(views=4, psnr=25.0, **changes) -> dict:
    about = {"data": "synthetic", "split": "val", "targets": "release", "protocol": "correct", "views": views}
    return {**about, "metrics": {"psnr": psnr, "ssim": 0.8}, **changes}


def test_reported_figures_stand_apart_and_are_never_the_best(tmp_path):
    """The paper's figures are never taken for measured ones."""
    write_run(tmp_path / "0", "full", 10.0, lpips=0.5)
    (table,) = tables_of(tmp_path, "table2")
    text = to_markdown(table)
    rows, header = body(text)
    assert header[0] == "Methods"
    assert rows["RoGSplat"][:3] == ["26.32", "0.9478", "0.0530"]
    assert rows["GPS-Gaussian"] == ["-"] * 6 + ["26.54", "0.9539", "0.0610"]
    # Alone among the measured rows, ours is the best of nothing.
    assert rows["Ours"][:3] == ["13.00", "0.9000", "0.5000"]
    order = list(rows)
    assert order[0] == "*as reported on THuman2.0, not measured here*"
    assert order.index("*measured here*") == order.index("Ours") - 1
    assert "not comparable" in text
    (alone,) = tables_of(tmp_path, "table2", reported=False)
    assert "RoGSplat" not in to_markdown(alone)
    assert "not comparable" not in to_markdown(alone)


def test_a_data_set_is_a_column_group_of_its_own(tmp_path):
    """Figures on other data never share a column with ours; the paper's data are shown alone."""
    write_run(tmp_path / "1", "full", 10.0, data="synthetic", views=(4,))
    start_run(tmp_path / "2", "full", data="humman")
    (table,) = tables_of(tmp_path, "table1", metrics=("psnr",))
    rows, header = body(to_markdown(table))
    assert header[1:] == ["ZJU-Mocap PSNR ↑", "HuMMan PSNR ↑", "synthetic PSNR ↑"]
    assert rows["GHG"] == ["27.94", "22.40", "-"]
    assert rows["Ours"] == ["-", "missing", "14.00"]
    write_run(tmp_path / "0", "full", 20.0, data="zju_mocap", views=(4,))
    (table,) = tables_of(tmp_path, "table1", metrics=("psnr",))
    assert body(to_markdown(table))[0]["Ours"] == ["24.00", "missing"]
    assert "HuMMan paper full seed 1" in to_markdown(table)
    assert "1 further run in the folder" in to_markdown(table)


def test_our_variants_are_told_apart_by_what_differs(tmp_path):
    """Several models of ours have names with what differs, and nothing else."""
    write_run(tmp_path / "0", "full", 20.0)
    write_run(tmp_path / "1", "full", 21.0, model={"name": "hull"})
    write_run(tmp_path / "2", "full", 22.0, model={"name": "hull"}, compat={"name": "release"})
    (table,) = tables_of(tmp_path, "table3", reported=False)
    rows, _ = body(to_markdown(table))
    assert {name: row[0] for name, row in rows.items()} == {
        "Ours (paper)": "24.00",
        "Ours (hull)": "25.00",
        "Ours (hull, compat release)": "**26.00**",
    }


def test_peers_have_names_of_their_own(tmp_path):
    """What is built after another method is not ours; it competes like ours."""
    for number, name in enumerate(("gps", "pixel", "hull")):
        write_run(tmp_path / str(number), "full", 20.0 + number, model={"name": name})
    (table,) = tables_of(tmp_path, "table3", reported=False)
    rows, _ = body(to_markdown(table))
    found = {name: row[0] for name, row in rows.items()}
    assert found == {"After GPS-Gaussian": "24.00", "Pixel-aligned": "25.00", "Ours (hull)": "**26.00**"}


def test_baselines_are_rows_that_do_not_compete(tmp_path):
    """A baseline that knows the truth is never the best."""
    write_run(tmp_path / "0", "full", 20.0)
    write_run(tmp_path / "1", "full", 30.0, method="true_depth")
    write_run(tmp_path / "2", "full", 19.0, model={"name": "hull"})
    (table,) = tables_of(tmp_path, "table3", reported=False)
    rows, _ = body(to_markdown(table))
    assert rows["Discs at the true depth"][0] == "34.00"
    assert rows["Ours (paper)"][0] == "**24.00**"


def test_other_methods_join_the_table_that_they_fit(tmp_path):
    """Another method's results appear only beside runs on the same data and protocol."""
    write_run(tmp_path / "runs" / "0", "full", 20.0)
    write_run(tmp_path / "runs" / "1", "full", 20.0, targets="midway")
    rows = [a_row(subject="a", psnr=24.0), a_row(subject="b", psnr=26.5)]
    rows.append(a_row(views=5, psnr=27.0, subjects=9))
    others = [read_others(others_file(tmp_path, rows))]
    release, midway = tables_of(tmp_path / "runs", "table2", others=others, reported=False)
    rows, _ = body(to_markdown(release))
    assert rows["GHG"] == ["-"] * 3 + ["**25.25**", "0.8000", "-", "**27.00**", "0.8000", "-"]
    assert rows["Ours"][3:5] == ["24.00", "**0.9000**"]
    assert "GHG: their code; means only where untested; of 9 subjects." in to_markdown(release)
    assert "seeds" not in release.caption
    assert "GHG" not in to_markdown(midway)
    assert "other,GHG" in to_csv([release])


def test_a_selection_of_subjects_is_one_of_other_methods_too(tmp_path):
    """They were compared over all of theirs."""
    write_run(tmp_path / "runs" / "0", "full", 20.0)
    rows = [a_row(subject="a", psnr=24.0), a_row(subject="b", psnr=26.5), a_row(views=5, psnr=27.0)]
    others = [read_others(others_file(tmp_path, rows))]
    options = {"layout": "table2", "reported": False, "subjects": re.compile("a")}
    (table,) = tables_of(tmp_path / "runs", others=others, **options)
    rows, _ = body(to_markdown(table))
    assert (rows["GHG"][3], rows["GHG"][6]) == ("**24.00**", "**27.00**")
    assert "means only where untested, of all its subjects, not of `a` alone." in to_markdown(table)
    others = [read_others(others_file(tmp_path, [a_row(subject="x")]))]
    with pytest.raises(InputError, match=r"subjects: expected .* of .*others\.json, such as x; found 'a'"):
        tables_of(tmp_path / "runs", others=others, **options)


def test_the_example_of_the_documentation_is_read(tmp_path):
    """The documented file is valid, with subjects and with means."""
    shutil.copy(EXAMPLE, tmp_path)
    rows = read_others(tmp_path / EXAMPLE.name)
    by_subject = rows.dropna(subset="subject").set_index("subject")
    assert by_subject["psnr"]["p1000001"] == 26.85
    assert by_subject["psnr"].mean() == pytest.approx((27.31 + 26.85) / 2)
    (mean,) = rows[rows["subject"].isna()].to_dict("records")
    assert (mean["views"], mean["count"]) == (5, 6)


@pytest.mark.parametrize(
    ("rows", "changes", "said"),
    [
        ([a_row()], {"format": "x"}, r"others\.json\.format: expected .* 'ghgs_lit\.others'; found 'x'"),
        ([a_row()], {"format_version": 2}, "format_version: expected to be 1; found 2"),
        ([a_row()], {"methd": "x"}, r"others\.json\.methd: expected no such key"),
        ([a_row()], {"source": ""}, "source: String should have at least 1 character; found ''"),
        ([], {}, "rows: List should have at least 1 item"),
        ([{**a_row(), "vews": 3}], {}, r"rows\[0\]\.vews: expected no such key"),
        ([a_row(), {"data": "x"}], {}, r"rows\[1\]\.split: expected a value; found none"),
        ([a_row(views="4")], {}, r"rows\[0\]\.views: expected to be a valid integer; found '4'"),
        ([a_row(views=True)], {}, r"rows\[0\]\.views: expected to be a valid integer; found True"),
        ([a_row(views=0)], {}, r"rows\[0\]\.views: expected to be greater than or equal to 1; found 0"),
        ([a_row(psnr="25")], {}, r"metrics\.psnr: expected to be a valid number; found '25'"),
        ([a_row(psnr=float("nan"))], {}, "expected to be a finite number; found nan"),
        ([a_row(subject="a"), a_row(subject="a")], {}, r"rows\[1\]: .* found one again"),
        ([a_row(), a_row()], {}, r"rows\[1\]: .* found one again"),
        ([a_row(subject="a"), a_row()], {}, "expected subjects or one mean .* found both"),
        ([a_row(subject="a", subjects=3)], {}, "found both"),
        ([5], {}, r"rows\[0\]: expected to be a valid dictionary .* found 5"),
    ],
)
def test_a_file_that_is_wrong_says_where(tmp_path, rows, changes, said):
    """A wrong entry is found by the place in the message."""
    with pytest.raises(InputError, match=said):
        read_others(others_file(tmp_path, rows, **changes))


def test_others_that_fit_nowhere_are_refused(tmp_path):
    """Results that no table can show are an error, not silence."""
    write_run(tmp_path / "runs", "full", 20.0)
    others = [read_others(others_file(tmp_path, [a_row(protocol="release")]))]
    with pytest.raises(InputError, match=r"protocol=correct'\]; found .*protocol=release"):
        tables_of(tmp_path / "runs", "table2", others=others)
    with pytest.raises(InputError, match="expected layout=table1, table2 or table3; found ablation"):
        tables_of(tmp_path / "runs", others=others)
    with pytest.raises(FileNotFoundError, match=r"none\.json"):
        read_others(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(InputError, match="expected JSON"):
        read_others(tmp_path / "bad.json")


def test_where_an_encoder_comes_from_makes_no_second_row(tmp_path):
    """The results of a run name it; its configuration before training does not."""
    path = write_run(tmp_path / "0", "full", 20.0, weights="vggt.safetensors").with_name("config.yaml")
    path.write_text(path.read_text().replace("vggt.safetensors", "null"))
    (table,) = tables_of(tmp_path, "table3", reported=False)
    assert [line.stub for line in table.lines] == [("Ours",)]
