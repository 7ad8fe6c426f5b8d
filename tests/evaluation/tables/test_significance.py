"""Paired tests over subjects: SciPy's numbers, Holm's correction, too few subjects, what is marked."""

import re

import numpy as np
import pytest
from scipy import stats

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables import to_markdown
from ghgs_lit.evaluation.tables.significance import PairedTest, compare, holm, too_few
from tests.helpers.tables import body, tables_of, write_run

RNG = np.random.default_rng(0)
SUBJECTS = {f"s{i:02d}": float(v) for i, v in enumerate(stats.zscore(RNG.normal(size=20)))}


def rows_of(values):
    return dict(zip(SUBJECTS, map(float, values), strict=False))


@pytest.mark.parametrize("n", [2, 7, 20])
def test_p_values_are_scipys(n):
    """The p-values are those of SciPy on the same pairs."""
    a, b = RNG.normal(size=n), RNG.normal(size=n) + 0.3
    w, t = (compare(rows_of(a), rows_of(b), kind) for kind in ("wilcoxon", "t"))
    assert w.p == pytest.approx(stats.wilcoxon(a, b).pvalue, rel=1e-9)
    assert t.p == pytest.approx(stats.ttest_rel(a, b).pvalue, rel=1e-9)
    assert w.n == n
    assert w.difference == pytest.approx((a - b).mean())


def test_pairs_are_the_subjects_that_both_have():
    """Rows with different subjects are compared on the common ones only."""
    a, b = {"x": 1.0, "y": 2.0, "z": 9.0}, {"y": 1.0, "x": 0.5, "w": 3.0}
    assert compare(a, b, "t").n == 2
    assert compare(a, b, "t").difference == pytest.approx(0.75)
    assert compare({"x": 1.0}, {"x": 2.0}, "t").p is None
    assert compare({"x": 1.0}, {"y": 2.0}, "t").difference is None


@pytest.mark.parametrize("kind", ["wilcoxon", "t"])
def test_equal_rows_and_constant_differences_are_defined(kind):
    """No division by zero where all differences are equal."""
    assert compare(SUBJECTS, SUBJECTS, kind).p == 1
    shifted = {name: value + 1.0 for name, value in SUBJECTS.items()}
    assert compare(shifted, SUBJECTS, kind).p < 1e-4


def test_holm_is_the_textbooks():
    """Holm's correction of known p-values, in their order."""
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9, 0.001]) == pytest.approx([1.0, 1.0, 0.003])
    assert holm([]) == []


def test_too_few_subjects_are_those_that_could_never_show_anything():
    """The exact test's least p is that of n differences of one sign."""
    for n in range(2, 12):
        least = stats.wilcoxon(np.arange(1.0, n + 1)).pvalue
        for comparisons in (1, 3, 27):
            hopeless = least * comparisons > 0.05
            assert (too_few(n, comparisons, PairedTest()) is not None) == hopeless
    assert too_few(4, 1, PairedTest("t")) is not None
    assert too_few(5, 1, PairedTest("t")) is None


def table_of(folder, shift, noise=0.01, shifts=SUBJECTS, seeds=(1,), **options):
    """`full` against `neither`, which is ``shift`` better."""
    for seed in seeds:
        write_run(folder / f"f{seed}", "full", 20.0, seed, views=(4,), shifts=shifts)
        moved = {k: v + noise * RNG.normal() for k, v in shifts.items()}
        write_run(folder / f"n{seed}", "neither", 20.0 + shift, seed, views=(4,), shifts=moved)
    (table,) = tables_of(folder, views=(4,), **options)
    return table


def test_a_clear_difference_is_marked_and_noise_is_not(tmp_path):
    """Marks and the note say what was tested, corrected over all comparisons."""
    table = table_of(tmp_path / "clear", 1.0)
    rows, _ = body(to_markdown(table))
    assert rows["✗", "✗"][0] == "**25.00\\***"
    assert rows["✓", "✓"][0] == "24.00"
    (note,) = (n for n in table.notes if "Wilcoxon" in n)
    assert "against the row of the whole method, n = 20 subjects" in note
    assert "Holm's correction over the 3 comparisons" in note
    cell = table.lines[0].cells[table.columns[0]]
    # Three comparisons: PSNR, and SSIM and FLIP, which are equal.
    assert cell.test.corrected == pytest.approx(3 * cell.test.p)
    table = table_of(tmp_path / "noise", 0.0, noise=1.0)
    assert "\\*" not in to_markdown(table)


def test_the_reference_can_be_the_best_and_the_test_another_or_none(tmp_path):
    """Every option of the test changes what is marked; others are refused."""
    table = table_of(tmp_path / "a", 1.0, test={"against": "best", "kind": "t"})
    rows, _ = body(to_markdown(table))
    assert rows["✗", "✗"][0] == "**25.00**"
    assert rows["✓", "✓"][0] == "24.00\\*"
    assert any("paired t test against its column's best row" in n for n in table.notes)
    table = table_of(tmp_path / "b", 1.0, test={"kind": "none"})
    assert "\\*" not in to_markdown(table)
    for wrong in ({"kind": "anova"}, {"against": "worst"}, {"alpha": 0}):
        with pytest.raises(InputError, match="test"):
            PairedTest(**wrong)


def test_few_subjects_are_said_and_not_marked(tmp_path):
    """Too few subjects give a note in place of marks that could never appear."""
    few = dict(list(SUBJECTS.items())[:6])
    table = table_of(tmp_path, 5.0, shifts=few)
    assert "\\*" not in to_markdown(table)
    assert any("n = 6 subjects are too few" in n and "0.094" in n for n in table.notes)


def test_a_t_test_of_four_subjects_marks_nothing_however_small_its_p(tmp_path):
    """With so few pairs normality cannot be seen, so a small p means nothing."""
    table = table_of(tmp_path, 5.0, shifts=dict(list(SUBJECTS.items())[:4]), test={"kind": "t"})
    assert table.lines[0].cells[table.columns[0]].test.corrected < 1e-4
    assert "\\*" not in to_markdown(table)
    assert any("fewer than 5 subjects" in n for n in table.notes)


def test_subjects_are_averaged_over_seeds_before_the_test(tmp_path):
    """More seeds do not give more subjects."""
    table = table_of(tmp_path, 1.0, seeds=(1, 2, 3))
    assert table.lines[0].cells[table.columns[0]].test.n == 20


def test_frames_of_one_person_are_one_pair(tmp_path):
    """Frames of one person are not independent and must not count as subjects."""
    frames = {f"p{i // 5}_{i % 5:03d}": float(v) for i, v in enumerate(RNG.normal(size=20))}
    table = table_of(tmp_path, 1.0, shifts=frames, unit=re.compile(r"(.+)_\d+"))
    assert table.lines[0].cells[table.columns[0]].test.n == 4
    assert any("n = 4 subjects are too few" in n for n in table.notes)
