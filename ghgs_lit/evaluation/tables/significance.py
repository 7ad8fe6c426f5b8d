"""Paired tests over subjects, corrected for the number of tests in a table."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ghgs_lit.errors import choice, require

KINDS = {"wilcoxon": "Wilcoxon signed-rank test", "t": "paired t test"}
_MIN_PAIRS_FOR_T = 5
"""With fewer pairs nobody can see whether the differences are normal."""


@dataclass(frozen=True)
class PairedTest:
    """Which test is made.

    Args:
        kind: ``wilcoxon``, ``t`` or ``none``.
        against: the reference row: ``full``, that of the whole method where there is exactly one; ``best``,
            the best of each column.
        alpha: level of significance.
    """

    kind: str = "wilcoxon"
    against: str = "full"
    alpha: float = 0.05

    def __post_init__(self) -> None:
        choice("test.kind", self.kind, (*KINDS, "none"))
        choice("test.against", self.against, ("full", "best"))
        require(0 < self.alpha < 1, "test.alpha", "a number between 0 and 1", self.alpha)


@dataclass(frozen=True)
class Comparison:
    """A row compared with the reference row of its column.

    Args:
        n: number of pairs.
        difference: mean of row minus reference; None without pairs.
        p: two-sided p-value; None where ``n`` is too small for a test.
        corrected: ``p`` after Holm's correction.
    """

    n: int
    difference: float | None
    p: float | None
    corrected: float | None = None


def compare(row: Mapping[str, float], reference: Mapping[str, float], kind: str) -> Comparison:
    """Compare two rows on the subjects that both have, one pair each; equal rows have p = 1.

    Args:
        row, reference: value of each subject.
        kind: ``wilcoxon`` or ``t``.
    """
    shared = sorted(set(row) & set(reference))
    differences = np.array([row[name] - reference[name] for name in shared], dtype=np.float64)
    if len(shared) < 2:
        return Comparison(len(shared), float(differences.mean()) if len(shared) else None, None)
    mean = float(differences.mean())
    if not differences.any():
        return Comparison(len(shared), 0.0, 1.0)
    if kind == "wilcoxon":
        p = float(stats.wilcoxon(differences, zero_method="pratt").pvalue)
    else:
        spread = differences.std(ddof=1)
        t = mean / (spread / math.sqrt(len(shared))) if spread > 0 else math.copysign(math.inf, mean)
        p = float(2 * stats.t.sf(abs(t), len(shared) - 1))
    return Comparison(len(shared), mean, p)


def holm(values: Sequence[float]) -> list[float]:
    """Holm's correction of p-values of one table, in their order."""
    order = np.argsort(values, kind="stable")
    scaled = np.asarray(values, dtype=np.float64)[order] * np.arange(len(values), 0, -1)
    corrected = np.empty(len(values))
    corrected[order] = np.minimum(np.maximum.accumulate(scaled), 1)
    return corrected.tolist()


def too_few(n: int, comparisons: int, settings: PairedTest) -> str | None:
    """Why ``n`` pairs cannot show a difference in a table of ``comparisons`` tests; None where they can."""
    if settings.kind == "t":
        return f"fewer than {_MIN_PAIRS_FOR_T} subjects" if n < _MIN_PAIRS_FOR_T else None
    # The smallest p of signs and ranks is that of differences with one sign.
    smallest = min(1.0, 2.0 ** (1 - n) * comparisons)
    if smallest <= settings.alpha:
        return None
    return f"even if every subject agreed, p could not fall below {smallest:.2g}"
