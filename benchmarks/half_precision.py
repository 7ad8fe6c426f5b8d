"""Training in bfloat16 autocast beside float32: curves, final PSNR, values that are not finite.

    OMP_NUM_THREADS=1 python benchmarks/half_precision.py --steps 2000 --seeds 1 2 3 --out runs/half_precision

A run that is there already is not trained again. The smallest model on photographs of 56 pixels: two minutes
for each run on one thread. Writes ``half_precision.png`` and prints a table.
"""

import argparse
import csv
import json
import math
import statistics
import subprocess
import sys
from pathlib import Path

from matplotlib.figure import Figure

PRECISIONS = {"float32": "32-true", "bfloat16": "bf16-mixed"}
SETTING = (
    "model=hull",
    "data=synthetic",
    "data.size=56",
    "data.people.train=16",
    "data.people.val=8",
    "views=v3",
    "loss=depth",
    "callbacks=none",
    "trainer.val_check_interval=200",
)


def train(directory: Path, precision: str, seed: int, steps: int) -> None:
    """One run in a process of its own."""
    options = [f"trainer.precision={PRECISIONS[precision]}", f"seed={seed}", f"trainer.max_steps={steps}"]
    place = [f"hydra.run.dir={directory}", "overwrite=true"]
    subprocess.run([sys.executable, "-m", "ghgs_lit", "train", *SETTING, *options, *place], check=True)


def curve(directory: Path, name: str) -> tuple[list[int], list[float]]:
    """Steps and values of a logged number."""
    with open(directory / "csv" / "metrics.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row.get(name)]
    return [int(row["step"]) + 1 for row in rows], [float(row[name]) for row in rows]


def final_psnr(directory: Path) -> float:
    """Of the first target protocol over all validation subjects, dB."""
    return json.loads((directory / "metrics.json").read_text())["summary"][0]["psnr"]


def draw(runs: dict[tuple[str, int], Path]) -> Figure:
    """Loss (means of 10 logged values) and validation PSNR of all runs."""
    figure = Figure(figsize=(10, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    colors = dict(zip(PRECISIONS, ("tab:blue", "tab:orange"), strict=True))
    for (precision, seed), directory in runs.items():
        label = precision if seed == min(s for _, s in runs) else None
        steps, losses = curve(directory, "loss/total")
        means = [statistics.mean(losses[max(0, i - 9) : i + 1]) for i in range(len(losses))]
        left.plot(steps, means, color=colors[precision], alpha=0.8, linewidth=1, label=label)
        right.plot(
            *curve(directory, "val/psnr"), color=colors[precision], alpha=0.8, linewidth=1, label=label
        )
    left.set(xlabel="step", ylabel="training loss", yscale="log")
    right.set(xlabel="step", ylabel="validation PSNR, dB")
    for axes in (left, right):
        axes.legend()
        axes.grid(alpha=0.3)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--out", type=Path, default=Path("runs/half_precision"))
    options = parser.parse_args()
    runs = {(p, seed): options.out / f"{p}_{seed}" for seed in options.seeds for p in PRECISIONS}
    for (precision, seed), directory in runs.items():
        if not (directory / "metrics.json").exists():
            train(directory, precision, seed, options.steps)
    print("| seed | float32, dB | bfloat16, dB | difference | values not finite |")
    print("|---|---|---|---|---|")
    for seed in options.seeds:
        full, half = (final_psnr(runs[p, seed]) for p in PRECISIONS)
        logged = [
            value
            for p in PRECISIONS
            for name in ("loss/total", "train/gradient_norm")
            for value in curve(runs[p, seed], name)[1]
        ]
        broken = sum(not math.isfinite(value) for value in logged)
        print(f"| {seed} | {full:.2f} | {half:.2f} | {half - full:+.2f} | {broken} of {len(logged)} |")
    found = {p: [final_psnr(runs[p, seed]) for seed in options.seeds] for p in PRECISIONS}
    for precision, values in found.items():
        spread = statistics.stdev(values) if len(values) > 1 else 0.0
        print(f"{precision}: mean {statistics.mean(values):.2f} dB, standard deviation {spread:.2f} dB")
    draw(runs).savefig(options.out / "half_precision.png", dpi=120)
    print(f"wrote {options.out / 'half_precision.png'}")


if __name__ == "__main__":
    main()
