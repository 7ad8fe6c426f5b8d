"""For which people the recalibration's parts help: differences of PSNR between rows of an ablation.

    python benchmarks/when_recalibration.py runs/ablation

Reads the runs of a sweep over ``ablation`` measured on ``evaluation.split=bench``
(docs/evidence/ablation.md), sorts the frozen people into thirds by what the paper's argument speaks of, and
compares the whole method with each of the other rows: PSNR inside the box, the test of tables over seeds and
the people of a third together, without correction. Sorted by

- limbs: the share of the skin that lies within 5 cm of another part of the body that is not its neighbour,
- texture: the contrast of the photographs within the subject, finer than 4 pixels,
- depth: the depth error of the row of the whole method.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pandas as pd
import torch.nn.functional as F
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree

from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import compose, resolve
from ghgs_lit.config.compose import read_option
from ghgs_lit.errors import require
from ghgs_lit.evaluation.tables.significance import compare
from ghgs_lit.synthesis.bench import definition, names
from ghgs_lit.synthesis.jobs import SyntheticSource
from ghgs_lit.synthesis.people.body import load_body
from ghgs_lit.training.pretext.labels import PARTS, vertex_parts

NEAR = 0.05  # metres
ROW = ["row", "views", "targets", "seed", "subject"]


def read(folder: Path, metric: str) -> pd.DataFrame:
    """A metric of the runs of a sweep: by row of the ablation, views, targets and seed, and by person."""
    runs = []
    for file in sorted(folder.glob("*/metrics.json")):
        content = json.loads(file.read_text())
        config = content["provenance"]["config"]
        row = f"{config['recalibration']['neighborhood']}, {config['recalibration']['similarity']}"
        runs.append(pd.DataFrame(content["rows"]).assign(row=row, seed=config["seed"]))
    rows = pd.concat(runs)
    return rows[rows["method"] == "model"].groupby(ROW)[metric].mean().unstack("subject")


def neighbors() -> np.ndarray:
    """Which parts touch each other on the body at rest."""
    body, parts = load_body(), vertex_parts()
    rest = body.rest(np.zeros_like(body.sample_shape(np.random.default_rng(0))[0]))[0][: len(parts)]
    touch = np.eye(len(PARTS), dtype=bool)
    for part in range(len(PARTS)):
        others = cKDTree(rest[parts == part]).query(rest)[0] < 0.02
        touch[part, np.unique(parts[others])] = True
    return touch | touch.T


def close_limbs(person: str, touch: np.ndarray) -> float:
    """The share of the skin that is near to a part that is not its neighbour."""
    seed, parts = definition()["data"]["people_seed"], vertex_parts()
    vertices = SyntheticSource(seed).load(person).body_vertices
    near = np.zeros(len(vertices), dtype=bool)
    for part in range(len(PARTS)):
        own = ~touch[part][parts]
        near[own] |= cKDTree(vertices[parts == part]).query(vertices[own])[0] < NEAR
    return float(near.mean())


def contrasts() -> dict[str, float]:
    """Fine contrast of each person's photographs."""
    data = build_data(resolve(compose("evaluate", ["data=synthetic", "evaluation.split=bench"])))
    found = {}
    for batch in data.evaluation_loader(4, [read_option("targets", "release")], split="bench", batch_size=1):
        gray, masks = batch.images[0].mean(1, keepdim=True), batch.masks[0, :, None].to(batch.images)
        inside = F.avg_pool2d(masks, 5, 1, 2)
        fine = gray - F.avg_pool2d(gray * masks, 5, 1, 2) / inside.clamp(min=1e-3)
        found[batch.subjects[0]] = float(fine[inside > 0.99].std())
    return found


def thirds(order: dict[str, float]) -> list[tuple[str, list[str]]]:
    """People in three groups of rising values."""
    ranked = sorted(order, key=order.__getitem__)
    return [
        (f"{order[part[0]]:.3g} to {order[part[-1]]:.3g}", list(part)) for part in np.array_split(ranked, 3)
    ]


def main() -> None:
    """Print a table for each other row of the ablation."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, help="folder of the sweep")
    folder, whole = parser.parse_args().runs, "xyz, product"
    values, depths = (read(folder, name) for name in ("psnr_box", "depth_error_mm"))
    found = list(values.index.unique("row"))
    require(whole in found, "runs", f"{folder}/<run>/metrics.json of the whole method", found)
    touch, texture = neighbors(), contrasts()
    errors = depths.loc[whole, 4, "midway"].mean().to_dict()
    orders = {"limbs": {p: close_limbs(p, touch) for p in names()}, "texture": texture, "depth, mm": errors}
    groups = [("all", "", names())]
    groups += [(name, span, people) for name, order in orders.items() for span, people in thirds(order)]
    settings = sorted(values.loc[whole].index.droplevel("seed").unique())
    for row in sorted(set(found) - {whole}):
        columns = ["by", "of", *(f"{views} views, {targets}" for views, targets in settings)]
        table = Table(*columns, title=f"{whole} minus {row}, dB in the box (p)")
        for name, span, people in groups:
            cells = []
            for setting in settings:
                test = compare(*(values.loc[(r, *setting)][people] for r in (whole, row)))
                cells.append(f"{test.difference:+.2f} ({'-' if test.p is None else f'{test.p:.3f}'})")
            table.add_row(name, span, *cells)
        Console(width=180).print(table)


if __name__ == "__main__":
    main()
