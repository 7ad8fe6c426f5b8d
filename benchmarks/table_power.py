"""Power and false positives of ``ghgs table`` in randomly sampled tables.

    python benchmarks/table_power.py [number of tables]

A value is the sum of its row's mean, random effects of its seed and its subject that rows share, and
interactions of the row with each seed (``deviations``), each subject and both. ``pairs``: each pair
of rows alone, corrected over three metrics as if all were tested; ``pooled``: as in ``ghgs table``;
``plain``: the same without the allowance for a reference that varies more than others. False stars
are counted where seeds dominate, which is the worst case for a pooled variance.
"""

import sys
import time
from collections.abc import Sequence

import numpy as np
import pandas as pd

from ghgs_lit.evaluation.tables.significance import ALPHA, compare, holm, pool, smallest_difference

SUBJECTS = 20
DEVIATION = 0.1
"""Deviation of a row over seeds, dB; for power, also of its interactions with subjects and of the rest."""
WAYS = ("pairs", "plain", "pooled")
PAPER = (0.0, -0.35, -0.74, -1.09)
"""The paper's differences from the whole method, and their sum for the row with neither, dB."""
ALONE = (0.0, -0.35, 0.0, 0.0)
"""The smallest of them, without larger ones that precede it in Holm's correction."""


def sample_rows(
    rng: np.random.Generator, means: Sequence[float], deviations: Sequence[float], seeds: int, people: float
) -> list[pd.DataFrame]:
    """Sample the rows of a table: values by seed and subject.

    Args:
        rng: Source of all samples.
        means: Means of the rows, dB.
        deviations: Deviations of the rows over seeds, dB.
        seeds: Number of seeds.
        people: Deviation of a row over subjects and of the rest, dB.
    """
    seed, subject = DEVIATION * rng.normal(size=(seeds, 1)), rng.normal(size=SUBJECTS)
    rows = []
    for mean, deviation in zip(means, deviations, strict=True):
        by_seed = deviation * rng.normal(size=(seeds, 1))
        by_subject = people * rng.normal(size=SUBJECTS)
        rest = people * rng.normal(size=(seeds, SUBJECTS))
        rows.append(pd.DataFrame(mean + seed + subject + by_seed + by_subject + rest))
    return rows


def mark_rows(rows: Sequence[pd.DataFrame], way: str) -> tuple[list[bool], float]:
    """Whether each row but the first is marked against it, and the mean of the smallest differences."""
    shared = None if way == "pairs" else pool(rows)
    if way == "plain":
        shared = shared._replace(rows=2)
    comparisons = [compare(row, rows[0], shared) for row in rows[1:]]
    others = [1.0] * (2 * len(comparisons)) if way == "pairs" else []
    corrected = holm([comparison.p for comparison in comparisons] + others)
    smallest = [smallest_difference(each, len(corrected)) for each in comparisons]
    return [p < ALPHA for p in corrected[: len(comparisons)]], float(np.mean(smallest))


def sample_tables(
    means: Sequence[float],
    ratios: Sequence[float],
    seeds: int,
    way: str,
    trials: int,
    people: float = DEVIATION,
    start: int = 0,
) -> tuple[np.ndarray, float]:
    """Sample and test tables.

    Args:
        means: Means of the rows, dB; the first is the reference.
        ratios: Deviations of the rows over seeds, in multiples of ``DEVIATION``.
        seeds: Number of seeds.
        way: One of ``WAYS``.
        trials: Number of tables.
        people: Deviation of a row over subjects and of the rest, dB.
        start: Seed of the random numbers.

    Returns:
        Marks [trials, rows - 1], and the root mean square of the smallest differences, dB.
    """
    rng = np.random.default_rng(start)
    deviations = [DEVIATION * ratio for ratio in ratios]
    found = [mark_rows(sample_rows(rng, means, deviations, seeds, people), way) for _ in range(trials)]
    return np.array([marks for marks, _ in found]), float(
        np.sqrt(np.mean([smallest**2 for _, smallest in found]))
    )


def main(trials: int = 100) -> None:
    """Print the shares of tables with false stars, the power by difference, and the smallest difference."""
    started = time.perf_counter()
    print(f"| tables with a false star | rows | seeds | {' | '.join(WAYS)} |\n|{'---|' * 6}")
    for name, ratios in (("alike", (1,)), ("reference twice", (2, 1)), ("reference and another", (2, 2, 1))):
        for rows, seeds in ((4, 3), (4, 5), (6, 3), (6, 6)):
            each = [*ratios, *[1] * rows][:rows]
            marks = [sample_tables([0] * rows, each, seeds, way, trials, 0.01)[0] for way in WAYS]
            shares = " | ".join(f"{each.any(axis=1).mean():.1%}" for each in marks)
            print(f"| {name} | {rows} | {seeds} | {shares} |")
    gains = " | ".join(f"{gain:+.2f} dB" for gain in PAPER[1:])
    print(f"\n| power | seeds | {ALONE[1]:+.2f} dB alone | {gains} |\n|{'---|' * 6}")
    for seeds in (3, 5):
        for way in WAYS:
            alone = sample_tables(ALONE, [1] * 4, seeds, way, trials)[0][:, :1].mean(axis=0)
            power = [*alone, *sample_tables(PAPER, [1] * 4, seeds, way, trials)[0].mean(axis=0)]
            print(f"| {way} | {seeds} | {' | '.join(f'{share:.0%}' for share in power)} |")
    for seeds in (3, 5):
        smallest = sample_tables([0] * 4, [1] * 4, seeds, "pooled", trials)[1]
        found = sample_tables([0, smallest, 0, 0], [1] * 4, seeds, "pooled", trials, start=1)[0]
        print(f"\n{seeds} seeds could have shown {smallest:.2f} dB: found in {found[:, 0].mean():.0%}")
    print(f"\n{trials} tables each, {time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
