"""Run time against error with the Pareto front, and cost against the size of a task, as figures."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from ghgs_lit.diagnostics.benchmark.report import totals
from ghgs_lit.files import write_atomically
from ghgs_lit.runs.results import Row

#: Relative differences below this are drawn as this: an axis of logarithms has no 0.
_FLOOR = 1e-9


@dataclass(frozen=True)
class Drawing:
    """A figure, and what is said of its elements when one points at them: text by the element's id."""

    figure: Figure
    hints: Mapping[str, str]

    def png(self) -> bytes:
        return self._saved("png", dpi=150)

    def svg(self) -> str:
        # Text stays text, and equal drawings are equal files.
        with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "ghgs"}):
            return self._saved("svg", metadata={"Date": None}).decode()

    def _saved(self, kind: str, **options: Any) -> bytes:
        content = io.BytesIO()
        self.figure.savefig(content, format=kind, **options)
        return content.getvalue()


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


def draw_presets(rows: Sequence[Row], machine: str, about: str) -> Drawing:
    """Run time against error, the Pareto front, and the budget of each preset.

    The error is the loss of PSNR against ``none``; of weights that nobody trained, the largest relative
    difference.

    Args:
        rows: of a benchmark.
        machine: what the times were measured on, in words.
        about: what was measured, in words.
    """
    whole = totals(rows)
    is_trained = all(row["trained"] for row in whole)
    error, budget = ("psnr_loss_db", "budget_db") if is_trained else ("max_rel_diff", "max_rel_diff_budget")

    def shown(value: float) -> float:
        return value if is_trained else min(max(value, _FLOOR), 1e3)

    figure, hints = Figure(figsize=(9, 5.5), layout="constrained"), {}
    axes = figure.add_subplot()
    colors = matplotlib.colormaps["tab10"]
    points = [(row["seconds"], shown(row[error])) for row in whole]
    front = [points[index] for index in pareto(points)]
    axes.plot(*zip(*front, strict=True), color="0.6", drawstyle="steps-post", zorder=1, label="Pareto front")
    for number, (row, (x, y)) in enumerate(zip(whole, points, strict=True)):
        color = colors(number % 10)
        axes.hlines(y, row["seconds_low"], row["seconds_high"], color=color, linewidth=2)
        axes.plot(x, y, "o", color=color, markersize=9, label=row["preset"], gid=f"point-{number}")
        hints[f"point-{number}"] = _hint(row)
        if row[budget] is not None and shown(row[budget]) > _FLOOR:
            limit = shown(row[budget])
            axes.plot([x, x], [y, limit], ":", color=color, linewidth=1)
            axes.plot(x, limit, "_", color=color, markersize=22, markeredgewidth=2.5, gid=f"budget-{number}")
            hints[f"budget-{number}"] = f"budget of {row['preset']}: {row[budget]:g}"
    axes.plot([], [], "_", color="0.3", markersize=14, markeredgewidth=2.5, label="budget")
    axes.set_xlim(left=0)
    axes.set_xlabel("seconds of a batch (median, quartiles)")
    axes.set_ylabel(
        "loss of PSNR against none, dB" if is_trained else "largest difference from none, relative"
    )
    if not is_trained:
        axes.set_yscale("log")
    axes.grid(alpha=0.3)
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    axes.set_title(f"{about}\n{machine}", fontsize=8)
    return Drawing(figure, hints)


def _hint(row: Row) -> str:
    peak = "" if row["peak_bytes"] is None else f", {row['peak_bytes'] / 1e6:.0f} MB"
    work = "" if row["flops"] is None else f", {row['flops'] / 1e9:.2f} GFLOP"
    loss = f"loss {row['psnr_loss_db']:+.3f} dB, difference {row['max_rel_diff']:.1e}"
    return f"{row['preset']}: {row['seconds']:.3f} s{peak}{work}; {loss}"


def draw_scaling(rows: Sequence[Row], fits: Sequence[Mapping[str, Any]], machine: str, about: str) -> Drawing:
    """Seconds of each preset along each axis of the scaling study, with the fitted exponents.

    Args:
        rows, fits: of the study.
        machine: what the times were measured on, in words.
        about: what was measured, in words.
    """
    whole = totals(rows)
    names = list(dict.fromkeys(row["axis"] for row in whole))
    presets = list(dict.fromkeys(row["preset"] for row in whole))
    figure, hints = Figure(figsize=(4.2 * len(names), 4), layout="constrained"), {}
    found = {(f["axis"], f["preset"], f["stage"]): f["exponent"] for f in fits}
    colors = matplotlib.colormaps["tab10"]
    for axes, name in zip(np.atleast_1d(figure.subplots(1, len(names), sharey=True)), names, strict=True):
        for number, preset in enumerate(presets):
            own = [row for row in whole if (row["axis"], row["preset"]) == (name, preset)]
            exponent = found.get((name, preset, "total"))
            label = preset if exponent is None else f"{preset}: exponent {exponent:.2f}"
            color = colors(number % 10)
            axes.plot([r["value"] for r in own], [r["seconds"] for r in own], "-", color=color, label=label)
            for row in own:
                gid = f"{name}-{number}-{row['value']}"
                axes.plot(row["value"], row["seconds"], "o", color=color, gid=gid)
                hints[gid] = f"{preset}, {name} {row['value']:g}: {row['seconds']:.3f} s"
        values = sorted({row["value"] for row in whole if row["axis"] == name})
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_xlabel(name)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7)
    figure.supylabel("seconds of a batch (median)", fontsize=9)
    figure.suptitle(f"{about}\n{machine}", fontsize=8)
    return Drawing(figure, hints)


def save_png(content: bytes, path: Path) -> None:
    """Write a PNG."""
    write_atomically(path, lambda temporary: temporary.write_bytes(content))
