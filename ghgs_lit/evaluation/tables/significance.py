"""Tests of two rows over seeds and subjects together, corrected for the number of tests in a table.

A row is some of many possible trainings, measured on some of many subjects: both are drawn by chance. The
squared standard errors over seeds and over subjects are added (min F', Clark 1973), and the degrees of
freedom are those of the fewer of the two (Mickey and Brown 1966), so that the level holds whichever varies
more.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats


@dataclass(frozen=True)
class Comparison:
    """A row compared with the reference row of its column, on the seeds and subjects that both have.

    Args:
        seeds, subjects: their numbers.
        difference: mean of row minus reference; None without pairs.
        low, high: the interval in which the difference lies with probability 1 - alpha, not corrected; None,
            as ``p``, with fewer than two seeds or subjects.
        p: two-sided p-value.
        corrected: ``p`` after Holm's correction.
    """

    seeds: int
    subjects: int
    difference: float | None = None
    low: float | None = None
    high: float | None = None
    p: float | None = None
    corrected: float | None = None


def compare(row: pd.DataFrame, reference: pd.DataFrame, alpha: float = 0.05) -> Comparison:
    """Compare two rows; equal ones have p = 1. ``row``, ``reference``: values by seed (index) and subject
    (columns). ``alpha``: one minus the probability of the interval."""
    row, reference = row.align(reference, join="inner")
    differences = (row - reference).dropna(axis="columns")
    seeds, subjects = differences.shape
    if not differences.size:
        return Comparison(seeds, subjects)
    mean = float(differences.to_numpy().mean())
    freedom = min(seeds, subjects) - 1
    if freedom < 1:
        return Comparison(seeds, subjects, mean)
    variance = differences.mean(axis="columns").var() / seeds + differences.mean().var() / subjects
    error = math.sqrt(variance)
    errors = abs(mean) / error if error > 0 else math.inf if mean else 0.0
    p = float(2 * stats.t.sf(errors, freedom))
    half = needed_errors(alpha, freedom + 1) * error
    return Comparison(seeds, subjects, mean, mean - half, mean + half, p)


def needed_errors(alpha: float, count: int, comparisons: int = 1) -> float:
    """Standard errors by which rows must differ to be marked first among ``comparisons``. ``alpha``: level of
    significance of all comparisons together. ``count``: number of seeds, or of subjects where they are fewer;
    2 or more."""
    return float(stats.t.isf(alpha / 2 / comparisons, count - 1))


def holm(values: Sequence[float]) -> list[float]:
    """Holm's correction of p-values of one table, in their order."""
    order = np.argsort(values, kind="stable")
    scaled = np.asarray(values, dtype=np.float64)[order] * np.arange(len(values), 0, -1)
    corrected = np.empty(len(values))
    corrected[order] = np.minimum(np.maximum.accumulate(scaled), 1)
    return corrected.tolist()
