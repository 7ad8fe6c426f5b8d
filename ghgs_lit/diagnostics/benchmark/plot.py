"""Run time against error with the Pareto front, as a figure."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from ghgs_lit.diagnostics.benchmark.report import totals
from ghgs_lit.runs.results import Row

#: Relative differences are drawn within these: an axis of logarithms has no 0.
_DRAWN = (1e-9, 1e3)
_COLORS = matplotlib.colormaps["tab10"]


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Indices of the points (time, error) that no other point beats, by time.

    A point is beaten by one that is better in one number and not worse in the other; of equal points the
    first counts.
    """
    front: list[int] = []
    for index in sorted(range(len(points)), key=lambda i: (points[i], i)):
        if not front or points[index][1] < points[front[-1]][1]:
            front.append(index)
    return front


def draw_presets(rows: Sequence[Row], machine: str, about: str) -> Figure:
    """Run time against error, the Pareto front, and the budget of each preset.

    The error is the loss of PSNR against ``none``; of weights that nobody trained, the largest relative
    difference.
    """
    whole = totals(rows)
    is_trained = all(row["trained"] for row in whole)
    error, budget = ("psnr_loss_db", "budget_db") if is_trained else ("max_rel_diff", "max_rel_diff_budget")

    def shown(value: float) -> float:
        return value if is_trained else float(np.clip(value, *_DRAWN))

    figure = Figure(figsize=(9, 5.5), layout="constrained")
    axes = figure.add_subplot()
    points = [(row["seconds"], shown(row[error])) for row in whole]
    front = [points[index] for index in pareto(points)]
    axes.plot(*zip(*front, strict=True), color="0.6", drawstyle="steps-post", zorder=1, label="Pareto front")
    for number, (row, (x, y)) in enumerate(zip(whole, points, strict=True)):
        color = _COLORS(number % 10)
        axes.hlines(y, row["seconds_low"], row["seconds_high"], color=color, linewidth=2)
        axes.plot(x, y, "o", color=color, markersize=9, label=row["preset"])
        if row[budget] is not None and shown(row[budget]) > _DRAWN[0]:
            limit = shown(row[budget])
            axes.plot([x, x], [y, limit], ":", color=color, linewidth=1)
            axes.plot(x, limit, "_", color=color, markersize=22, markeredgewidth=2.5)
    axes.plot([], [], "_", color="0.3", markersize=14, markeredgewidth=2.5, label="budget")
    axes.set_xlim(left=0)
    axes.set_xlabel("seconds of a batch (median, quartiles)")
    said = "loss of PSNR against none, dB" if is_trained else "largest difference from none, relative"
    axes.set_ylabel(said)
    if not is_trained:
        axes.set_yscale("log")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    axes.set_title(f"{about}\n{machine}", fontsize=8)
    return figure
