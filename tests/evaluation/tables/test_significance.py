"""Tests over seeds and subjects: their level and power, and Holm's correction."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from benchmarks import table_power
from ghgs_lit.evaluation.tables.significance import ALPHA, POWER, RATIO, Pool, compare, holm, pool

RNG = np.random.default_rng(0)
SEED_EFFECT, SUBJECT_EFFECT = 0.1, 1.0  # dB


def runs_of(rng, seeds, subjects, people, own=0.0, noise=0.05):
    """Values of a configuration: ``people`` [subjects], random effects of seeds and of its people,
    and noise."""
    by_person = people + own * rng.normal(size=subjects)
    by_seed = SEED_EFFECT * rng.normal(size=(seeds, 1))
    return pd.DataFrame(by_person + by_seed + noise * rng.normal(size=(seeds, subjects)))


@pytest.mark.parametrize("own", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("seeds", [2, 3, 6])
def test_a_configuration_against_itself_is_marked_at_most_at_the_level(seeds, own):
    """Under two names, whether seeds or people dominate: within the error of this number of trials."""
    rng, trials, alpha = np.random.default_rng(1), 300, 0.05
    marked = 0
    for _ in range(trials):
        people = SUBJECT_EFFECT * rng.normal(size=16)
        row, reference = (runs_of(rng, seeds, 16, people, own) for _ in range(2))
        marked += compare(row, reference).p < alpha
    assert marked <= stats.binom.ppf(0.999, trials, alpha)


def test_the_interval_holds_the_difference():
    """It does so in at least 95 of 100 cases, and p is small where it does not contain 0."""
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
    marks, _ = table_power.sample_tables([0] * len(ratios), ratios, seeds, "pooled", trials, 0.01)
    assert marks.any(axis=1).sum() <= stats.binom.ppf(0.999, trials, ALPHA)


def test_a_pooled_variance_finds_what_pairs_of_rows_do_not():
    """With the paper's differences and three seeds; the smallest detectable difference is detected."""
    trials, alike = 100, [1] * 4
    pairs, pooled = (
        table_power.sample_tables(table_power.PAPER, alike, 3, way, trials)[0] for way in ("pairs", "pooled")
    )
    for before, after in zip(pairs.sum(axis=0), pooled.sum(axis=0), strict=True):
        counts = [[after, trials - after], [before, trials - before]]
        assert stats.fisher_exact(counts, alternative="greater").pvalue < 0.001
    _, said = table_power.sample_tables([0] * 4, alike, 3, "pooled", trials)
    found = table_power.sample_tables([0, said, 0, 0], alike, 3, "pooled", trials, start=1)[0][:, 0].sum()
    assert found >= stats.binom.ppf(0.001, trials, POWER)


def test_the_pooled_variance_is_that_of_a_regression_on_rows_and_seeds():
    """Also where rows lack seeds; a subject that a row lacks at one of them does not count."""
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
    """Rows with disjoint seeds have no residuals."""
    rows = [pd.DataFrame(RNG.normal(size=(2, 3)), index=seeds) for seeds in ([1, 2], [3, 4])]
    assert pool(rows).freedom == 0


@pytest.mark.parametrize("rows", [2, 3, 4, 6])
def test_the_reference_may_vary_twice_as_much(rows):
    """Largest ratio of the variance of a difference to that expected from the pooled one; 1 for two rows."""
    variances = np.array([RATIO**2] + [1] * (rows - 1))
    expected = variances[:2].sum() / (2 * variances.mean())
    pooled = Pool(0.3, 8, rows)
    values = pd.DataFrame(np.zeros((3, 20)))
    comparison = compare(values + 1, values, pooled=pooled)
    assert comparison.error == pytest.approx(np.sqrt(2 * 0.3 * expected / 3))
    assert comparison.freedom == 8


def test_the_statistic_is_a_paired_t_test_where_seeds_decide():
    """Of the means of seeds: equal to SciPy's where people agree."""
    a, b = RNG.normal(size=5), RNG.normal(size=5)
    row, reference = (pd.DataFrame(np.repeat(values[:, None], 9, 1)) for values in (a, b))
    assert compare(row, reference).p == pytest.approx(stats.ttest_rel(a, b).pvalue, rel=1e-6)


def test_pairs_are_the_seeds_and_subjects_that_both_have():
    """Other seeds, other subjects, and subjects that lack a seed are excluded."""
    row = pd.DataFrame([[1.0, 2, 9, 4], [2, 3, 9, np.nan]], index=[1, 2], columns=list("xyzv"))
    reference = pd.DataFrame([[0.5, 1, 0, 3]] * 3, index=[2, 1, 3], columns=list("xywv"))
    comparison = compare(row, reference)
    assert (comparison.seeds, comparison.subjects) == (2, 2)
    assert comparison.difference == pytest.approx(1.25)
    alone = compare(row.loc[[1]], reference)
    assert np.isnan([alone.p, alone.low, alone.high]).all()
    assert np.isnan(compare(row[["z"]], reference[["w"]]).difference)


def test_equal_rows_and_constant_differences_are_defined():
    """No division by zero where all differences are equal."""
    values = pd.DataFrame(np.arange(6.0).reshape(2, 3))
    assert compare(values, values).p == 1
    assert compare(values + 1, values).p < 1e-9


def test_holm_is_the_textbooks():
    """Known p-values are corrected, in their order."""
    assert holm([0.01, 0.04, 0.03]).tolist() == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, np.nan, 0.9, 0.001]).dropna().tolist() == pytest.approx([1.0, 1.0, 0.003])
    assert holm([]).empty
