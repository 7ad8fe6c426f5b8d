"""Tests of differences between rows of a table, with intervals and smallest detectable differences.

A value is the sum of a fixed effect of its row, random effects of the seed and the subject, which
rows share, and their interactions with the row: a mixed model with crossed effects. Seeds are few:
their variance is pooled over all rows of a column (residuals of the two-way table of rows and seeds).
Subjects are many: their variance is estimated for each pair of rows. The two squared standard errors
are added (min F', Clark 1973), with the degrees of freedom of the smaller sample (Mickey and Brown
1966), so that the level holds whichever of the two varies more.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy import stats
from scipy.optimize import brentq

ALPHA = 0.05
"""Significance level of all comparisons of a table together, and of single intervals."""
POWER = 0.8
"""Power of the smallest difference that is printed below a table."""
RATIO = 2.0
"""Ratio of the deviations of rows over seeds up to which the level holds."""


class Comparison(NamedTuple):
    """Comparison of a row with the reference row of its column, on the seeds and subjects of both.

    With fewer than two seeds or subjects, the interval and the p-value are nan.

    Attributes:
        seeds: Number of seeds.
        subjects: Number of subjects.
        difference: Mean of row minus reference; nan without pairs.
        low: Lower end of its interval at level 1 - ``ALPHA``, not corrected.
        high: Upper end of that interval.
        p: Two-sided p-value, not corrected.
        error: Standard error of the difference.
        freedom: Degrees of freedom of the error.
    """

    seeds: int
    subjects: int
    difference: float = math.nan
    low: float = math.nan
    high: float = math.nan
    p: float = math.nan
    error: float = math.nan
    freedom: int = 0


class Pool(NamedTuple):
    """Variance of a row over seeds, pooled over several rows.

    Attributes:
        variance: The pooled variance.
        freedom: Degrees of freedom, 0 if unknown.
        rows: Number of rows.
    """

    variance: float
    freedom: int
    rows: int


def pool(rows: Sequence[pd.DataFrame]) -> Pool:
    """Pool the variance of rows over seeds.

    Each row is averaged over the subjects that it has at all its seeds. Rows may lack seeds.

    Args:
        rows: Values of each row by seed (index) and subject (columns).

    Returns:
        The variance; its degrees of freedom are 0 if it cannot be estimated.
    """
    means = [row.dropna(axis="columns").mean(axis="columns") for row in rows]
    table = pd.concat(means, axis="columns", keys=range(len(rows)))
    cells = table[table.count(axis="columns") > 1].stack().dropna()
    if cells.empty:
        return Pool(0.0, 0, 0)
    seed, row = (pd.get_dummies(cells.index.get_level_values(level)) for level in (0, 1))
    effects = np.hstack([seed, row]).astype(float)
    solution, _, rank, _ = np.linalg.lstsq(effects, cells)
    residuals = cells - effects @ solution
    freedom = len(cells) - int(rank)
    return Pool(float(residuals @ residuals) / max(freedom, 1), freedom, row.shape[1])


def compare(row: pd.DataFrame, reference: pd.DataFrame, pooled: Pool | None = None) -> Comparison:
    """Compare two rows of values.

    Args:
        row, reference: Values by seed (index) and subject (columns).
        pooled: Variance over seeds of all rows of the column; None: of these two (a paired t test).
    """
    row, reference = row.align(reference, join="inner")
    differences = (row - reference).dropna(axis="columns")
    seeds, subjects = differences.shape
    if not differences.size:
        return Comparison(seeds, subjects)
    mean = float(differences.to_numpy().mean())
    if min(seeds, subjects) < 2:
        return Comparison(seeds, subjects, mean)
    both = [part[differences.columns] for part in (row, reference)]
    pooled = pooled if pooled and pooled.freedom else pool(both)
    freedom = min(pooled.freedom, subjects - 1)
    # Largest ratio of the variance of a difference to twice the pooled one, if the deviation of the
    # reference is RATIO times that of the others; 1 for two rows.
    allowance = (RATIO**2 + 1) * pooled.rows / (2 * (RATIO**2 + pooled.rows - 1))
    over_seeds = 2 * allowance * pooled.variance / seeds
    error = math.sqrt(over_seeds + differences.mean().var() / subjects)
    errors = abs(mean) / error if error > 0 else math.inf if mean else 0.0
    p = float(2 * stats.t.sf(errors, freedom))
    half = float(stats.t.isf(ALPHA / 2, freedom)) * error
    return Comparison(seeds, subjects, mean, mean - half, mean + half, p, error, freedom)


def smallest_difference(comparison: Comparison, comparisons: int) -> float:
    """Difference that is significant with a probability of ``POWER``, by the noncentral t
    distribution.

    Args:
        comparison: With its standard error and degrees of freedom.
        comparisons: Number of comparisons, at least 1.

    Returns:
        The difference, in the unit of the metric; nan without a standard error.
    """
    freedom = comparison.freedom
    if not freedom:
        return math.nan
    needed = stats.t.isf(ALPHA / 2 / comparisons, freedom)
    errors = brentq(lambda errors: stats.nct.sf(needed, freedom, errors) - POWER, 0, 2 * needed + 10)
    return float(comparison.error * errors)


def holm(values: Sequence[float]) -> pd.Series:
    """Holm's correction of p-values (Holm 1979).

    Args:
        values: p-values of all comparisons of a table; nan: none.

    Returns:
        Corrected p-values in the same order, at most 1; nan stays nan.
    """
    ordered = pd.Series(values, dtype=float).sort_values(kind="stable")
    scaled = ordered * np.arange(ordered.count(), ordered.count() - len(ordered), -1)
    return scaled.cummax().clip(upper=1).sort_index()
