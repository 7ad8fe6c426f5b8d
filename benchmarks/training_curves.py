"""Losses of trainings, a colour for each model: ``python benchmarks/training_curves.py runs/peers out.png``.

Loss of images, 0.8 L1 + 0.2 (1 - SSIM), and depth term (of rounds: their sum), means of five logged steps.
"""

import sys
from pathlib import Path

import matplotlib
import pandas as pd
import yaml

matplotlib.use("Agg")
import matplotlib.pyplot as plt

TITLES = {"image": "loss of images", "loss/depth": "depth term, metres"}


def main() -> None:
    folder, out = map(Path, sys.argv[1:])
    figure, axes = plt.subplots(1, len(TITLES), figsize=(10, 3.6), layout="constrained")
    colors: dict[str, str] = {}
    for file in sorted(folder.glob("*/csv/metrics.csv")):
        name = yaml.safe_load((file.parents[1] / "config.yaml").read_text())["model"]["name"]
        rows, known = pd.read_csv(file).set_index("step"), name in colors
        rows["image"] = 0.8 * rows["loss/render_l1"] + 0.2 * rows["loss/render_ssim"]
        color = colors.setdefault(name, f"C{len(colors)}")
        for axis, column in zip(axes, TITLES, strict=True):
            values = rows[column].dropna().rolling(5, center=True, min_periods=1).mean()
            axis.plot(values, color=color, label=None if known else name)
    for axis, title in zip(axes, TITLES.values(), strict=True):
        axis.set(title=title, xlabel="steps", yscale="log")
        axis.grid(alpha=0.3, which="both")
    axes[1].legend(ncols=2)
    figure.savefig(out, dpi=80)


if __name__ == "__main__":
    main()
