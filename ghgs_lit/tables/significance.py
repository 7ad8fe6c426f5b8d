"""Paired tests over subjects, corrected for how many of them a table makes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from ghgs_lit.errors import choice, require

KINDS = {"wilcoxon": "Wilcoxon signed-rank test", "t": "paired t test"}
_LEAST_FOR_T = 5
"""Pairs below which nobody can see whether differences are normal."""


@dataclass(frozen=True)
class PairedTest:
    """Which test: ``kind`` (``wilcoxon``, ``t``, ``none``), against which row (``full``: the whole method's
    where there is exactly one; ``best``: each column's best), at which level ``alpha``."""

    kind: str = "wilcoxon"
    against: str = "full"
    alpha: float = 0.05

    def __post_init__(self) -> None:
        choice("test.kind", self.kind, (*KINDS, "none"))
        choice("test.against", self.against, ("full", "best"))
        require(0 < self.alpha < 1, "test.alpha", "a number between 0 and 1", self.alpha)


@dataclass(frozen=True)
class Comparison:
    """A row against the reference row of its column: ``n`` pairs, mean ``difference`` (row minus
    reference), two-sided ``p`` and its Holm correction; None where ``n`` is too small to be tested."""

    n: int
    difference: float | None
    p: float | None
    corrected: float | None = None


def compare(row: Mapping[str, float], reference: Mapping[str, float], kind: str) -> Comparison:
    """The subjects that both have, one pair each. Equal rows have p = 1."""
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
    """Holm's correction of p-values that are looked at together, in their order."""
    order = np.argsort(values, kind="stable")
    scaled = np.asarray(values, dtype=np.float64)[order] * np.arange(len(values), 0, -1)
    corrected = np.empty(len(values))
    corrected[order] = np.minimum(np.maximum.accumulate(scaled), 1)
    return corrected.tolist()


def too_few(n: int, comparisons: int, settings: PairedTest) -> str | None:
    """Why ``n`` pairs cannot show anything among that many comparisons; None where they can."""
    if settings.kind == "t":
        return f"fewer than {_LEAST_FOR_T} subjects" if n < _LEAST_FOR_T else None
    # All differences of one sign are the most that signs and ranks can say.
    least = min(1.0, 2.0 ** (1 - n) * comparisons)
    if least <= settings.alpha:
        return None
    return f"even if every subject agreed, p could not fall below {least:.2g}"
