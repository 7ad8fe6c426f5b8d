"""Tests over seeds and subjects: their level and power, Holm's correction,
what is marked and said."""

import re

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmarks import table_power
from ghgs_lit.config.nodes import PairedTest
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables import to_markdown
from ghgs_lit.evaluation.tables.significance import POWER, RATIO, Pool, compare, holm, needed_errors, pool
from tests.helpers.tables import body, tables_of, write_run

RNG = np.random.default_rng(0)
SUBJECTS = {f"s{i:02d}": float(v) for i, v in enumerate(stats.zscore(RNG.normal(size=20)))}
SEED_EFFECT, SUBJECT_EFFECT = 0.1, 1.0  # dB


def runs_of(rng, seeds, subjects, people, own=0.0, noise=0.05):
    """A configuration: ``people`` [subjects], a chance of each seed, of it with each person,
    and the rest."""
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


@pytest.mark.parametrize(
    ("ratios", "seeds"),
    [((1, 1, 1, 1), 3), ((2, 1, 1, 1), 3), ((2, 2, 1, 1), 5), ((1,) * 6, 6), ((2, 1, 1, 1, 1, 1), 3)],
)
def test_tables_of_equal_rows_have_a_star_at_most_at_the_level(ratios, seeds):
    """Also where the deviations of rows differ by a factor of two."""
    trials = 150
    marks, _ = table_power.tables([0] * len(ratios), ratios, seeds, "pooled", trials, 0.01)
    assert marks.any(axis=1).sum() <= stats.binom.ppf(0.999, trials, table_power.ALPHA)


def test_a_pooled_variance_finds_what_pairs_of_rows_do_not():
    """The paper's differences with three seeds; what is said to be found is found."""
    trials, alike = 100, [1] * 4
    pairs, pooled = (
        table_power.tables(table_power.PAPER, alike, 3, way, trials)[0] for way in ("pairs", "pooled")
    )
    for before, after in zip(pairs.sum(axis=0), pooled.sum(axis=0), strict=True):
        counts = [[after, trials - after], [before, trials - before]]
        assert stats.fisher_exact(counts, alternative="greater").pvalue < 0.001
    _, said = table_power.tables([0] * 4, alike, 3, "pooled", trials)
    found = table_power.tables([0, said, 0, 0], alike, 3, "pooled", trials, start=1)[0][:, 0].sum()
    assert found >= stats.binom.ppf(0.001, trials, POWER)


def test_the_pooled_variance_is_that_of_a_regression_on_rows_and_seeds():
    """Also where rows lack seeds, and a subject that a row lacks at one of them does not count."""
    rows = [pd.DataFrame(RNG.normal(size=(4, 5)), index=[1, 2, 3, 4]) for _ in range(4)]
    rows[1], rows[2] = rows[1].drop(index=2), rows[2].drop(index=[1, 4])
    rows[3].loc[3, 0] = np.nan
    means = pd.concat([*(row.mean(axis=1) for row in rows[:3]), rows[3][[1, 2, 3, 4]].mean(axis=1)], axis=1)
    cells = means.stack().dropna()
    seed, row = (pd.get_dummies(cells.index.get_level_values(i)).to_numpy(float) for i in (0, 1))
    _, (squares,), rank, _ = np.linalg.lstsq(np.hstack([row, seed[:, 1:]]), cells.to_numpy())
    pooled = pool(rows)
    assert (pooled.freedom, pooled.rows) == (len(cells) - rank, 4)
    assert pooled.variance == pytest.approx(squares / pooled.freedom)


def test_seeds_of_one_row_alone_say_nothing_about_their_variance():
    """Rows of other seeds have no residuals."""
    rows = [pd.DataFrame(RNG.normal(size=(2, 3)), index=seeds) for seeds in ([1, 2], [3, 4])]
    assert pool(rows).freedom == 0


@pytest.mark.parametrize("rows", [2, 3, 4, 6])
def test_the_reference_may_vary_twice_as_much(rows):
    """Largest ratio of the variance of a difference to what the pooled one expects;
    1 for two rows."""
    variances = np.array([RATIO**2] + [1] * (rows - 1))
    expected = variances[:2].sum() / (2 * variances.mean())
    pooled = Pool(0.3, 8, rows)
    assert pooled.allowance == pytest.approx(expected)
    values = pd.DataFrame(np.zeros((3, 20)))
    comparison = compare(values + 1, values, pooled=pooled)
    assert comparison.error == pytest.approx(np.sqrt(2 * 0.3 * expected / 3))
    assert comparison.freedom == 8


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
    assert compare(values + 1, values).p < 1e-9


def test_holm_is_the_textbooks():
    """Holm's correction of known p-values, in their order."""
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9, 0.001]) == pytest.approx([1.0, 1.0, 0.003])
    assert holm([]) == []


def test_how_many_standard_errors_are_needed():
    """A difference of exactly as many has the p-value of the level, corrected."""
    for freedom, comparisons in ((1, 1), (2, 27), (5, 9)):
        p = 2 * stats.t.sf(needed_errors(0.05, freedom, comparisons), freedom)
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
    """Marks, intervals of all that was tested, and the notes say what,
    and what could have been shown."""
    table = table_of(tmp_path / "clear", 1.0)
    rows, _ = body(to_markdown(table))
    assert re.fullmatch(r"\*\*25\.00 ± 0\.00\\\* \[\+(0\.9|1\.0)\d, \+1\.0\d\]\*\*", rows["✗", "✗"][0])
    assert rows["✓", "✓"][0] == "24.00 ± 0.00"
    (note,) = (n for n in table.notes if "beyond chance" in n)
    assert "from the row of the whole method: two-sided t test over 3 seeds and 20 subjects together" in note
    assert "Holm's correction over the 1 comparison of" in note
    assert "95 % interval" in note
    assert "PSNR differs" in note
    assert "other metrics are not tested" in note
    test = table.cells["test"].iloc[0]
    (note,) = (n for n in table.notes if "could have shown" in n)
    assert note.startswith(
        f"3 seeds and 20 subjects could have shown {test.smallest:.2f} dB of PSNR (with 80 %"
    )
    assert test.corrected == test.p
    assert table.cells["test"].notna().sum() == 1
    every = table_of(tmp_path / "every", 1.0, test={"metrics": ["flip", "psnr", "ssim"]})
    assert every.comparisons == 3
    assert not any("not tested" in n for n in every.notes)
    test = every.cells["test"].iloc[0]
    assert test.corrected == pytest.approx(3 * test.p)
    equal = table_of(tmp_path / "equal", 0.0, noise=0.0)
    assert any("beyond chance" in n for n in equal.notes)
    assert not any("could have shown" in n for n in equal.notes)
    table = table_of(tmp_path / "noise", 0.0, noise=1.0)
    assert "\\* [" not in to_markdown(table)
    assert not table.cells["marked"].any()
    assert re.fullmatch(
        r"\d\d\.\d\d ± \d\.\d\d \[-\d\.\d\d, \+\d\.\d\d\]", body(to_markdown(table))[0]["✗", "✗"][0]
    )


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
    with pytest.raises(
        InputError, match=r"test\.metrics: expected one of psnr, ssim, flip; found 'psnr_box'"
    ):
        table_of(tmp_path / "c", 1.0, test={"metrics": "psnr_box"})
    for wrong in ({"against": "worst"}, {"alpha": 0}):
        with pytest.raises(InputError, match="test"):
            PairedTest(**wrong)


def test_the_best_row_of_errors_is_the_lowest(tmp_path):
    for name, lpips in (("full", 0.2), ("neither", 0.1)):
        for seed in (1, 2):
            write_run(tmp_path / f"{name}{seed}", name, 20.0, seed, views=(4,), lpips=lpips)
    (table,) = tables_of(
        tmp_path, views=(4,), metrics=("lpips",), test={"against": "best", "metrics": "lpips"}
    )
    rows, _ = body(to_markdown(table))
    assert rows["✗", "✗"][0] == "**0.1000 ± 0.0000**"
    assert rows["✓", "✓"][0].startswith("0.2000 ± 0.0000\\* [+0.1000")


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


def test_the_variance_is_pooled_over_all_rows_of_a_column(tmp_path):
    """Four rows of three seeds have six degrees of freedom, not two."""
    for name in ("full", "no_unprojection", "no_semantic", "neither"):
        for seed in (1, 2, 3):
            psnr = 20.0 + RNG.normal()
            write_run(tmp_path / f"{name}{seed}", name, psnr, seed, shifts=SUBJECTS, views=(4,))
    (table,) = tables_of(tmp_path, views=(4,))
    tests = table.cells["test"].dropna()
    assert [test.freedom for test in tests] == [6, 6, 6]
    assert len({test.error for test in tests}) == 1  # no row differs in its people


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
