"""Tables of invented runs against expected files, and rejected runs, options and files.

``written(case, suffix, folder)`` returns the text of a file of ``tests/fixtures/tables``.
"""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables import PREAMBLE, read_sweep, to_csv, to_latex, to_markdown
from ghgs_lit.evaluation.tables.runs import encoder_name, find_views_of_columns
from ghgs_lit.evaluation.tables.writers import markdown_to_latex
from ghgs_lit.runs.results import config_hash, read_results, summarize, write_results
from tests.evaluation.tables.scenarios import CASES, REFUSED, RUNS, views
from tests.helpers.tables import tables_of, write_run

EXPECTED = Path(__file__).parents[2] / "fixtures" / "tables"
WRITERS = {
    ".md": lambda tables: "\n".join(map(to_markdown, tables)),
    ".tex": lambda tables: "\n".join(to_latex(table, "table:x") for table in tables),
    ".csv": to_csv,
}


def built(runs: str, options: dict, folder: Path) -> list:
    """The tables of invented runs."""
    for number, (row, psnr, about) in enumerate(RUNS[runs]):
        write_run(folder / "runs" / str(number), row, psnr, **about)
    # A half-written file and a foreign one, neither of which is a run.
    for name, text in (("half", "ablation: {name: ["), ("foreign", "a: 1")):
        (folder / "runs" / name).mkdir()
        (folder / "runs" / name / "config.yaml").write_text(text)
    return tables_of(folder / "runs", **options)


def written(case: str, suffix: str, folder: Path) -> str:
    return WRITERS[suffix](built(*CASES[case], folder)).replace(f"{folder}/", "")


@pytest.mark.parametrize("file", sorted(EXPECTED.iterdir()), ids=lambda file: file.name)
def test_a_table_is_the_expected_one(file, tmp_path):
    assert written(file.stem, file.suffix, tmp_path) == file.read_text()


def test_every_case_has_a_file():
    assert {file.stem for file in EXPECTED.iterdir()} == set(CASES)


@pytest.mark.parametrize(("runs", "options", "message"), REFUSED)
def test_what_no_table_can_show_is_refused(runs, options, message, tmp_path):
    with pytest.raises(InputError, match=message):
        built(runs, options, tmp_path)


def test_text_of_all_kinds_is_escaped():
    """No name of a run or file can break the LaTeX."""
    assert markdown_to_latex("a_b & 50% #1 {x} ^~\\ $") == (
        r"a\_b \& 50\% \#1 \{x\} \textasciicircum{}\textasciitilde{}\textbackslash{} \$"
    )
    assert (
        markdown_to_latex("**No** `a_b` (✗, ✓) ± 1")
        == r"\textbf{No} \texttt{a\_b} (\xmark{}, \cmark{}) $\pm$ 1"
    )
    assert markdown_to_latex(r"\* differs, p < 0.05") == r"$^{*}$ differs, p \textless{} 0.05"


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no TeX engine")
def test_latex_compiles(tmp_path):
    """A TeX engine accepts every expected file, and no table is wider than the page."""
    parts = [file.read_text() for file in sorted(EXPECTED.parent.glob("*tables/*.tex"))]
    head = (
        r"\documentclass[twocolumn]{article}\usepackage{booktabs,multirow,adjustbox,pifont}\begin{document}"
    )
    (tmp_path / "t.tex").write_text("\n".join([head, PREAMBLE, *parts, r"\end{document}"]))
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-draftmode", "t.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Overfull" not in done.stdout


def test_rows_stand_in_the_order_of_the_command(tmp_path):
    """Names of folders, which are hashes, do not matter."""
    for name, rate in (("a", 10), ("b", 9), ("c", 0.25)):
        write_run(tmp_path / name, "full", 20.0, optimizer={"lr": rate})
    (tmp_path / "multirun.yaml").write_text("seed: 1\nruns: [c, a, b]\n")
    (table,) = tables_of(tmp_path, "table2", by=["optimizer.lr"], reported=False)
    assert [line.stub for line in table.lines] == [(f"Ours (optimizer.lr={r})",) for r in ("0.25", "10", "9")]


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("views.training", ["any", "even"]),
        ("targets.training_views", [[0], [2, 3]]),
        ("targets.per_step", [1, 2]),
        ("targets.view", [2, 3]),
        ("targets.per_subject", [1, "all"]),
    ],
)
@pytest.mark.parametrize("seeds", [(1, 2), (1, 1)])
@pytest.mark.parametrize("protocols", [None, ("release", "release"), ("release", "midway")])
def test_other_views_and_targets_share_no_row(tmp_path, key, values, seeds, protocols):
    """They change the model, or its protocol, as much as another learning rate does; values of a protocol
    that a run selected but that the table does not show are ignored."""
    group, _, name = key.partition(".")
    for number, value in enumerate(values):
        nodes = {"views": views(4), "targets": {"name": "release", "training_views": [2], "per_step": 3}}
        nodes["targets"] |= {"view": 3, "per_subject": 1}
        nodes[group][name] = value
        measured = protocols and {"targets": nodes["targets"] | {"name": protocols[number]}}
        of = {f"of_{group}": node for group, node in nodes.items()}
        is_same = protocols == ("release", "midway") and name in ("view", "per_subject")
        psnr = 20.0 if is_same else 20.0 + number
        write_run(tmp_path / str(number), "full", psnr, seeds[number], measured=measured, **of)
    options = {"layout": "table2", "reported": False, "metrics": ("psnr",)}
    if not is_same:
        with pytest.raises(InputError, match=rf"by=\[{key}\]"):
            tables_of(tmp_path, **options)
    (table,) = tables_of(tmp_path, by=[] if is_same else [key], **options)
    names = [""] if is_same else [f" ({key}={value})" for value in values]
    assert [line.stub for line in table.lines] == [(f"Ours{name}",) for name in names]
    assert list(table.cells["mean"][:, 0, "psnr"]) == ([23.0] if is_same else [23.0, 24.0])


@pytest.mark.parametrize(
    ("runs", "layout", "comparisons"), [("clear", "table4", 2), ("models_with_seeds", "table3", 3)]
)
def test_a_reference_that_its_figures_chose_counts_all_pairs(runs, layout, comparisons, tmp_path):
    (table,) = built(runs, {"layout": layout, "reported": False}, tmp_path)
    assert table.comparisons == comparisons
    clearest = table.cells.sort_values("test_p").iloc[0]
    assert clearest["test_p_holm"] == pytest.approx(comparisons * clearest["test_p"])


def test_a_subject_counts_once_however_many_targets_it_has(tmp_path):
    path = write_run(tmp_path, "full", 20.0, views=(4,))
    content = json.loads(path.read_text())
    of_a, of_b = content["rows"]
    content["rows"] = [of_a, {**of_a, "target": "001/3", "psnr": 26.0}, of_b]
    path.write_text(json.dumps(content))
    (table,) = tables_of(tmp_path, metrics=("psnr",))
    assert list(table.measured["mean"]) == [((23.0 + 26.0) / 2 + 25.0) / 2]


def test_where_an_encoder_comes_from_makes_no_second_row(tmp_path):
    """Results of a run contain the weights' file; its configuration before training does not."""
    path = write_run(tmp_path / "0", "full", 20.0, encoder={"weights": "vggt.safetensors"})
    path = path.with_name("config.yaml")
    path.write_text(path.read_text().replace("vggt.safetensors", "null"))
    (table,) = tables_of(tmp_path, "table3", reported=False)
    assert [line.stub for line in table.lines] == [("Ours",)]


@pytest.mark.parametrize("name", ["vggt_nano", "vggt_small", "vggt_1b"])
def test_encoders_of_the_package_have_their_names(name):
    """A file overrides single keys of the nested ``vit``."""
    assert encoder_name(run_of("train", [f"encoder={name}"]).plain) == name


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("readme", "", "expected runs with a metrics.json below it; found none"),
        ("config.yaml", "{trainer: {}, data: {}, recalibration: {}}", "1 runs without one"),
        ("metrics.json", "{", r"metrics\.json"),
        ("metrics.json", '{"format_version": 2}', "format_version 3; found 2 .*evaluate"),
        ("metrics.json", '{"format_version": 99}', "format_version 3; found 99"),
    ],
)
def test_missing_damaged_and_newer_results_are_refused(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        read_sweep([tmp_path])
    with pytest.raises(FileNotFoundError, match="expected a directory of runs; found a file"):
        read_sweep([tmp_path / name])


PROVENANCE, ROW = "provenance", ("rows", 0)


@pytest.mark.parametrize(
    ("value", "keys", "message"),
    [
        (KeyError, [PROVENANCE], "provenance: expected a value; found none"),
        ([1], [PROVENANCE], r"provenance: expected to be a valid dictionary; found \[1\]"),
        ("x", [PROVENANCE, "config"], "provenance.config: expected to be a valid dictionary; found 'x'"),
        (KeyError, [PROVENANCE, "config", "recalibration"], "recalibration: expected a mapping"),
        ("one", [PROVENANCE, "config", "seed"], "provenance.seed: expected a whole number; found 'one'"),
        (KeyError, [PROVENANCE, "data"], "provenance.data.name: expected a value; found none"),
        (3, [PROVENANCE, "data", "split"], "provenance.data.split: expected to be a valid string; found 3"),
        (None, [PROVENANCE, "protocol"], "provenance.protocol.metrics: expected a value; found none"),
        (3, [PROVENANCE, "training"], "provenance.training: expected to be a valid dictionary; found 3"),
        (
            "0" * 12,
            [PROVENANCE, "config_hash"],
            "config: expected a configuration that fits its config_hash 0",
        ),
        (KeyError, ["rows"], "rows: expected a value; found none"),
        ({}, ["rows"], "rows: expected to be a valid list; found {}"),
        ("x", ROW, r"rows\[0\]: expected to be a valid dictionary"),
        ("high", [*ROW, "psnr"], r"rows\[0\]\.psnr: expected to be a valid number.*; found 'high'"),
        ("four", [*ROW, "views"], r"rows\[0\]\.views: expected to be a valid integer.*; found 'four'"),
        (KeyError, [*ROW, "subject"], r"rows\[0\]\.subject: expected a value; found none"),
        (3, ["summary"], "summary: expected to be a valid list; found 3"),
    ],
)
def test_edited_results_are_one_line(tmp_path, value, keys, message):
    """The error of a manually edited results file names the wrong key."""
    facts = {"training": {"steps": 1}, "git": {"commit": "a" * 40}}
    path = write_run(tmp_path / "0", "full", 20.0, provenance=facts)
    content = json.loads(path.read_text())
    *parents, last = keys
    edited = content
    for key in parents:
        edited = edited[key]
    if value is KeyError:
        del edited[last]
    else:
        edited[last] = value
    if parents[1:] == ["config"]:
        content["provenance"]["config_hash"] = config_hash(content["provenance"]["config"])
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=re.compile(rf"^[^\n]*metrics\.json[^\n]*{message}[^\n]*$")):
        read_sweep([tmp_path])


def test_undefined_values_are_null_and_left_out_of_means(tmp_path):
    """nan and infinity never reach JSON or a mean, and each subject counts once."""
    about = {"method": "model", "views": 3, "targets": "release", "target": "t", "inputs": ["a", "b"]}
    about["depth_error_mm"] = None
    rows = [
        {**about, "subject": "a", "psnr": 20.0, "psnr_box": float("nan")},
        {**about, "subject": "a", "psnr": 30.0, "psnr_box": 10.0},
        {**about, "subject": "a", "psnr": 34.0, "psnr_box": float("nan")},
        {**about, "subject": "b", "psnr": 40.0, "psnr_box": float("inf")},
    ]
    (means,) = summarize(rows[:3])
    assert (means["psnr_box"], means["depth_error_mm"]) == (10, None)
    (means,) = summarize(rows)
    assert (means["psnr"], means["subjects"]) == ((28 + 40) / 2, 2)
    content = read_results(write_results(tmp_path, rows, {"seed": 1}))
    assert [row["psnr_box"] for row in content["rows"]] == [None, 10, None, None]
    assert not list(tmp_path.glob(".*"))
    with pytest.raises(InputError, match="at least one"):
        write_results(tmp_path, [], {})


@pytest.mark.parametrize(
    ("counts", "expected"),
    [
        ([[3], [4]], {"0": 3, "1": 4}),
        ([[4], [4]], {}),
        ([[3], [3, 4]], {}),
        ([[3], [4], [3, 4, 5]], {"0": 3, "1": 4}),
    ],
)
def test_models_of_one_number_of_views_each_fill_one_column(counts, expected):
    """A model that was trained with several numbers of views fills all columns."""
    configs = {str(i): {"data": {"name": "thuman2"}, "views": views(*one)} for i, one in enumerate(counts)}
    assert find_views_of_columns(configs) == expected
