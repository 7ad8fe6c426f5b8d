"""Tests over seeds and subjects: their level and power, Holm's correction, what is marked and said."""

import re

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from ghgs_lit.config.nodes import PairedTest
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables import to_markdown
from ghgs_lit.evaluation.tables.cells import compare, holm, needed_errors
from tests.helpers.tables import body, tables_of, write_run

RNG = np.random.default_rng(0)
SUBJECTS = {f"s{i:02d}": float(v) for i, v in enumerate(stats.zscore(RNG.normal(size=20)))}
SEED_EFFECT, SUBJECT_EFFECT = 0.1, 1.0  # dB


def runs_of(rng, seeds, subjects, people, own=0.0, noise=0.05):
    """A configuration: ``people`` [subjects], a chance of each seed, of it with each person, and the rest."""
    by_person = people + own * rng.normal(size=subjects)
    by_seed = SEED_EFFECT * rng.normal(size=(seeds, 1))
    return pd.DataFrame(by_person + by_seed + noise * rng.normal(size=(seeds, subjects)))


@pytest.mark.parametrize("own", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("seeds", [2, 3, 6])
def test_a_configuration_against_itself_is_marked_at_most_at_the_level(seeds, own):
    """Under two names, whether seeds or people decide: within the error of so many trials."""
    rng, trials, alpha = np.random.default_rng(1), 300, 0.05
    marked = 0
    for _ in range(trials):
        people = SUBJECT_EFFECT * rng.normal(size=16)
        row, reference = (runs_of(rng, seeds, 16, people, own) for _ in range(2))
        marked += compare(row, reference).p < alpha
    assert marked <= stats.binom.ppf(0.999, trials, alpha)


def test_a_table_of_one_configuration_is_marked_at_most_at_the_level(tmp_path):
    """Three names, three seeds each; the reference is the row of the whole method or the best."""
    rng, trials, alpha = np.random.default_rng(2), 12, 0.05
    marked = {"full": 0, "best": 0}
    for trial in range(trials):
        people = SUBJECT_EFFECT * rng.normal(size=8)
        folder = tmp_path / str(trial)
        for name in ("full", "no_semantic", "neither"):
            for seed, values in runs_of(rng, 3, 8, people).iterrows():
                shifts = {f"p{i}": float(value) for i, value in values.items()}
                write_run(folder / f"{name}{seed}", name, 20.0, seed, views=(4,), shifts=shifts)
        for against in marked:
            (table,) = tables_of(folder, views=(4,), test={"against": against})
            marked[against] += bool(table.cells["marked"].any())
    assert max(marked.values()) <= stats.binom.ppf(0.999, trials, alpha)


@pytest.mark.parametrize(("seeds", "gain"), [(3, 1.5), (4, 0.8), (6, 0.4)])
def test_a_difference_of_several_deviations_is_marked(seeds, gain):
    """Among nine comparisons, too; with few seeds it must be larger."""
    rng, trials, marked = np.random.default_rng(3), 50, 0
    for _ in range(trials):
        people = SUBJECT_EFFECT * rng.normal(size=16)
        row, reference = (runs_of(rng, seeds, 16, people) for _ in range(2))
        marked += 9 * compare(row + gain, reference).p < 0.05
    assert marked > 0.8 * trials


def test_the_interval_holds_the_difference():
    """In 95 of 100 cases or more, and p is small where it does not hold 0."""
    rng, trials, inside = np.random.default_rng(4), 300, 0
    for _ in range(trials):
        row, reference = (runs_of(rng, 4, 16, np.zeros(16)) for _ in range(2))
        comparison = compare(row + 0.3, reference)
        inside += comparison.low < 0.3 < comparison.high
        assert (comparison.low > 0 or comparison.high < 0) == (comparison.p < 0.05)
        assert comparison.low < comparison.difference < comparison.high
    assert inside >= stats.binom.ppf(0.001, trials, 0.95)


def test_the_statistic_is_a_paired_t_test_where_seeds_decide():
    """Of the means of seeds: SciPy's number where people agree."""
    a, b = RNG.normal(size=5), RNG.normal(size=5)
    row, reference = (pd.DataFrame(np.repeat(values[:, None], 9, 1)) for values in (a, b))
    assert compare(row, reference).p == pytest.approx(stats.ttest_rel(a, b).pvalue, rel=1e-6)


def test_pairs_are_the_seeds_and_subjects_that_both_have():
    """Other seeds and other subjects are left out, and a subject that a seed lacks."""
    row = pd.DataFrame([[1.0, 2, 9, 4], [2, 3, 9, np.nan]], index=[1, 2], columns=list("xyzv"))
    reference = pd.DataFrame([[0.5, 1, 0, 3]] * 3, index=[2, 1, 3], columns=list("xywv"))
    comparison = compare(row, reference)
    assert (comparison.seeds, comparison.subjects) == (2, 2)
    assert comparison.difference == pytest.approx(1.25)
    alone = compare(row.loc[[1]], reference)
    assert alone.p is alone.low is alone.high is None
    assert compare(row[["z"]], reference[["w"]]).difference is None


def test_equal_rows_and_constant_differences_are_defined():
    """No division by zero where all differences are equal."""
    values = pd.DataFrame(np.arange(6.0).reshape(2, 3))
    assert compare(values, values).p == 1
    assert compare(values + 1, values).p == 0


def test_holm_is_the_textbooks():
    """Holm's correction of known p-values, in their order."""
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9, 0.001]) == pytest.approx([1.0, 1.0, 0.003])
    assert holm([]) == []


def test_how_many_standard_errors_are_needed():
    """A difference of exactly as many has the p-value of the level, corrected."""
    for count, comparisons in ((2, 1), (3, 27), (6, 9)):
        p = 2 * stats.t.sf(needed_errors(0.05, count, comparisons), count - 1)
        assert p * comparisons == pytest.approx(0.05)


def table_of(folder, shift, noise=0.01, shifts=SUBJECTS, seeds=(1, 2, 3), **options):
    """`full` against `neither`, which is ``shift`` better."""
    for seed in seeds:
        write_run(folder / f"f{seed}", "full", 20.0, seed, views=(4,), shifts=shifts)
        moved = {k: v + noise * RNG.normal() for k, v in shifts.items()}
        write_run(folder / f"n{seed}", "neither", 20.0 + shift, seed, views=(4,), shifts=moved)
    (table,) = tables_of(folder, views=(4,), **options)
    return table


def test_a_clear_difference_is_marked_and_noise_is_not(tmp_path):
    """Marks, the interval beside them and the note say what was tested, corrected over all comparisons."""
    table = table_of(tmp_path / "clear", 1.0)
    rows, _ = body(to_markdown(table))
    assert re.fullmatch(r"\*\*25\.00 ± 0\.00\\\* \[\+(0\.9|1\.0)\d, \+1\.0\d\]\*\*", rows["✗", "✗"][0])
    assert rows["✓", "✓"][0] == "24.00 ± 0.00"
    (note,) = (n for n in table.notes if "beyond chance" in n)
    assert "from the row of the whole method: two-sided t test over 3 seeds and 20 subjects together" in note
    assert "Holm's correction over the 3 comparisons" in note
    assert "95 % interval" in note
    assert f"With 3 seeds or subjects a difference must be {needed_errors(0.05, 3, 3):.3g}" in note
    # Three comparisons: PSNR, and SSIM and FLIP, which are equal.
    test = table.cells["test"].iloc[0]
    assert test.corrected == pytest.approx(3 * test.p)
    table = table_of(tmp_path / "noise", 0.0, noise=1.0)
    assert "\\* [" not in to_markdown(table)
    assert not table.cells["marked"].any()


def test_the_reference_can_be_the_best_or_none(tmp_path):
    """Every option of the test changes what is marked; others are refused."""
    table = table_of(tmp_path / "a", 1.0, test={"against": "best"})
    rows, _ = body(to_markdown(table))
    assert rows["✗", "✗"][0] == "**25.00 ± 0.00**"
    assert rows["✓", "✓"][0].startswith("24.00 ± 0.00\\* [-1.0")
    assert any("from its column's best row" in n for n in table.notes)
    table = table_of(tmp_path / "b", 1.0, test={"against": "none"})
    assert "\\*" not in to_markdown(table)
    assert not any("differences" in n for n in table.notes)
    for wrong in ({"against": "worst"}, {"alpha": 0}):
        with pytest.raises(InputError, match="test"):
            PairedTest(**wrong)


def test_every_pair_counts_where_the_reference_is_the_best(tmp_path):
    """The best of several equal rows is best by chance."""
    for name in ("full", "no_semantic", "neither"):
        for seed in (1, 2, 3):
            moved = {k: v + RNG.normal() for k, v in SUBJECTS.items()}
            write_run(tmp_path / f"{name}{seed}", name, 20.0, seed, views=(4,), shifts=moved)
    (full,) = tables_of(tmp_path, views=(4,), metrics=("psnr",))
    (best,) = tables_of(tmp_path, views=(4,), metrics=("psnr",), test={"against": "best"})
    assert (full.comparisons, best.comparisons) == (2, 3)
    assert best.cells["test"].notna().sum() == 2


def test_one_seed_is_said_and_not_marked(tmp_path):
    """One training each cannot tell methods apart, however many subjects it is measured on."""
    for name, seeds in (("one", (1,)), ("several", (1, 2))):
        table = table_of(tmp_path / name, 5.0, seeds=seeds)
        assert ("\\*" in to_markdown(table)) == (name == "several")
        said = "No differences are marked: rows have fewer than two seeds in common"
        assert any(said in note for note in table.notes) == (name == "one")


def test_rows_without_common_seeds_are_not_marked(tmp_path):
    """Runs are paired by their seeds."""
    for seed in (1, 2, 3):
        write_run(tmp_path / f"f{seed}", "full", 20.0, seed, views=(4,))
        write_run(tmp_path / f"n{seed}", "neither", 25.0, seed + 3, views=(4,))
    (table,) = tables_of(tmp_path, views=(4,))
    assert "\\*" not in to_markdown(table)
    assert any("fewer than two seeds in common" in note for note in table.notes)
    assert any("different seeds (✗ ✗: 4, 5, 6; ✓ ✓ (a): 1, 2, 3)" in note for note in table.notes)


def test_frames_of_one_person_are_one_subject(tmp_path):
    """Frames of one person are not independent and must not count as subjects."""
    frames = {f"p{i // 5}_{i % 5:03d}": float(v) for i, v in enumerate(RNG.normal(size=20))}
    table = table_of(tmp_path / "a", 1.0, shifts=frames, unit=re.compile(r"(.+)_\d+"))
    assert table.cells["test"].iloc[0].subjects == 4
    assert any("3 seeds and 4 subjects together" in n for n in table.notes)
    table = table_of(tmp_path / "b", 1.0, shifts=frames, unit=re.compile(r"(p)\d_\d+"))
    assert any("fewer than two subjects in common" in n for n in table.notes)
