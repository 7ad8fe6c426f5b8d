"""LaTeX tables against the layout of the paper's own,
and through a TeX engine where there is one."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from ghgs_lit.evaluation.tables import PREAMBLE, to_latex
from ghgs_lit.evaluation.tables.writers import escape, prose
from tests.helpers.latex import check_balance, read_tabular
from tests.helpers.tables import SWITCHES, start_run, tables_of, write_run

PAPER = json.loads((Path(__file__).parents[2] / "fixtures" / "paper_tables.json").read_text())
DATA = {
    "table1": ("zju_mocap", "humman"),
    "table2": ("thuman2",),
    "table3": ("thuman2",),
    "table4": ("thuman2",),
}


def of_layout(folder, layout, ablations=("full",), seeds=(1,), **options):
    for data in DATA.get(layout, ("synthetic",)):
        for ablation in ablations:
            for seed in seeds:
                where = folder / f"{data}{ablation}{seed}"
                write_run(where, ablation, 20.0 + seed / 10, seed, data=data, lpips=0.05, weights="w")
    (table,) = tables_of(folder, layout, **options)
    return table


@pytest.mark.parametrize("layout", ["table1", "table2", "table3", "table4"])
def test_the_layout_and_the_reported_figures_are_the_papers(tmp_path, layout):
    """Columns, headings, rules, digits and reported figures are those of the paper's tables."""
    latex = to_latex(of_layout(tmp_path, layout), "table:x")
    check_balance(latex)
    ours, paper = read_tabular(latex), PAPER[layout]
    assert ours["columns"] == paper["columns"]
    assert ours["headings"] == paper["headings"]
    assert ours["cmidrules"] == paper["cmidrules"]
    assert ours["metrics"] == [m.replace(" ", "") for m in paper["metrics"]]
    # The reported rows, cell by cell; then ours, as wide and with as many digits.
    reported = [[cell.replace("mark{}", "mark") for cell in cells] for cells, _ in ours["rows"]]
    assert reported[: len(paper["rows"])] == [cells for cells, _ in paper["rows"]]
    for cells, _ in ours["rows"]:
        assert len(cells) == len(paper["rows"][0][0])
        for cell, example in zip(cells, paper["rows"][-1][0], strict=True):
            if cell not in ("missing", "-") and re.fullmatch(r"[\d.]+", example):
                assert len(cell.split(".")[1]) == len(example.split(".")[1])
    # Rules of booktabs from top to bottom, one float, one caption, one label.
    rules = re.findall(r"\\(toprule|midrule|bottomrule)", latex)
    assert rules[0] == "toprule"
    assert rules[-1] == "bottomrule"
    assert latex.count(r"\caption{") == latex.count(r"\label{table:x}") == 1
    wide = layout in ("table2",)
    assert (r"\begin{table*}" in latex) == wide


def test_bold_deviation_marks_and_seeds_in_latex(tmp_path):
    """Everything that a cell can show is valid LaTeX."""
    shifts = {f"s{i:02d}": 0.01 * i - 0.095 for i in range(20)}
    for seed in (1, 2):
        write_run(tmp_path / f"f{seed}", "full", 20.0 + seed, seed, shifts=shifts, views=(4,))
        write_run(tmp_path / f"n{seed}", "neither", 19.0 + seed, seed, shifts=shifts, views=(4,))
    start_run(tmp_path / "n3", "neither", 3)
    (table,) = tables_of(tmp_path, views=(4,))
    latex = to_latex(table, "table:a")
    check_balance(latex)
    assert r"\textbf{25.50} $\pm$ 0.71" in latex
    assert r"24.50 $\pm$ 0.71$^{*}$ [-1.00, -1.00] (2/3)" in latex
    assert "- & - & -" in latex


def test_text_of_all_kinds_is_escaped():
    """No name of a run or file can break the LaTeX."""
    assert escape("a_b & 50% #1 {x} ^~\\ $") == (
        r"a\_b \& 50\% \#1 \{x\} \textasciicircum{}\textasciitilde{}\textbackslash{} \$"
    )
    assert prose("**No** `a_b` (✗, ✓) ± 1") == r"\textbf{No} \texttt{a\_b} (\xmark{}, \cmark{}) $\pm$ 1"
    assert prose("* differs, p < 0.05") == r"* differs, p \textless{} 0.05"


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no TeX engine")
def test_every_layout_compiles(tmp_path):
    """A TeX engine accepts every layout, and no table is wider than the page."""
    parts = [PREAMBLE]
    for layout in ("ablation", "table1", "table2", "table3", "table4"):
        table = of_layout(tmp_path / layout, layout, tuple(SWITCHES), (1, 2))
        parts.append(to_latex(table, f"table:{layout}"))
    packages = r"\usepackage{booktabs,multirow,adjustbox,pifont}"
    head = rf"\documentclass[twocolumn]{{article}}{packages}\begin{{document}}"
    (tmp_path / "t.tex").write_text("\n".join([head, *parts, r"\end{document}"]))
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "-draftmode", "t.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout[-2000:]
    assert "Overfull" not in done.stdout
