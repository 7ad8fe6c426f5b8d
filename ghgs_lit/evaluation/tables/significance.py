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
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Comparison:
    """Comparison of a row with the reference row of its column, on the seeds and subjects of both.

    With fewer than two seeds or subjects, the interval, the p-values and all values derived from them
    are None.

    Attributes:
        seeds: Number of seeds.
        subjects: Number of subjects.
        difference: Mean of row minus reference; None without pairs.
        low: Lower end of its interval at level 1 - ``ALPHA``, not corrected.
        high: Upper end of that interval.
        p: Two-sided p-value.
        corrected: p-value after Holm's correction.
        error: Standard error of the difference.
        freedom: Degrees of freedom of the error.
        smallest: The difference that is detected with a probability of ``POWER`` among all
            comparisons of the table.
    """

    seeds: int
    subjects: int
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    p: float | None = None
    corrected: float | None = None
    error: float | None = None
    freedom: int | None = None
    smallest: float | None = None


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
    table = pd.concat(means, axis="columns").to_numpy()
    table = table[(~np.isnan(table)).sum(axis=1) > 1]
    known = ~np.isnan(table)
    seed, row = np.nonzero(known)
    if not len(seed):
        return Pool(0.0, 0, 0)
    # Partial out the effects of seeds from values and row indicators (Frisch-Waugh-Lovell).
    values = (table - np.nanmean(table, axis=1, keepdims=True))[seed, row]
    indicators = np.eye(len(rows))[row] - (known / known.sum(axis=1, keepdims=True))[seed]
    effects, _, rank, _ = np.linalg.lstsq(indicators, values)
    residuals = values - indicators @ effects
    freedom = len(values) - len(table) - int(rank)
    return Pool(float(residuals @ residuals) / max(freedom, 1), freedom, len(set(row)))


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
    return Comparison(seeds, subjects, mean, mean - half, mean + half, p, error=error, freedom=freedom)


def smallest_difference(comparison: Comparison, comparisons: int) -> float:
    """Difference that is significant with a probability of ``POWER``, by the noncentral t
    distribution.

    Args:
        comparison: With its standard error and degrees of freedom.
        comparisons: Number of comparisons, at least 1.

    Returns:
        The difference, in the unit of the metric.
    """
    freedom = comparison.freedom
    needed = stats.t.isf(ALPHA / 2 / comparisons, freedom)
    errors = brentq(lambda errors: stats.nct.sf(needed, freedom, errors) - POWER, 0, 2 * needed + 10)
    return float(comparison.error * errors)


def holm(values: Sequence[float]) -> list[float]:
    """Holm's correction of p-values (Holm 1979).

    Args:
        values: p-values of all comparisons of a table.

    Returns:
        Corrected p-values in the same order, at most 1.
    """
    ordered = pd.Series(values, dtype=float).sort_values(kind="stable")
    scaled = ordered * np.arange(len(ordered), 0, -1)
    return scaled.cummax().clip(upper=1).sort_index().tolist()
