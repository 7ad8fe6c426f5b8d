"""Faces, hands and legs at full size, half-way between two of four photographs, side by side.

    python benchmarks/faces.py shipped other.ckpt --refine 15 --out faces
    python benchmarks/faces.py shipped --subjects p3000001 --size 252

Writes a sheet for each sealed built-in person, in which a checkpoint has two columns, its render
and the error, beside the photograph; prints PSNR, spill and sharpness. By default the best, the
median and the worst person of the weights that come with the package.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import run_of
from ghgs_lit.config.compose import read_option
from ghgs_lit.evaluation.measure import ModelMethod
from ghgs_lit.execution import Predictor
from ghgs_lit.metrics.functional import psnr, sharpness, spill
from ghgs_lit.refinement import Refinement
from ghgs_lit.rendering import render
from ghgs_lit.visualization.pictures import error_map, row, save_png, stack, to_uint8

#: By PSNR half-way at 518 x 518 (docs/evidence/shipped.md).
BEST_MEDIAN_WORST = ["p3000006", "a3000000", "p3000008"]
#: Sides of crops as shares of the person's height, and the row from which the legs are shown.
HEAD = 0.2
HAND = 0.16
LEGS = 0.5
#: Times that heads and hands are enlarged.
ENLARGED = 3


def crops(mask: Bool[Tensor, "h w"]) -> dict[str, tuple[slice, slice]]:
    """Rows and columns of parts of a person, by name.

    Args:
        mask: of the person, upright. Hands are where it is widest, below the head.
    """
    rows = mask.any(1).nonzero()[:, 0]
    top = int(rows[0])
    height = int(rows[-1]) + 1 - top
    chin = top + round(HEAD * height)
    knees = top + round(LEGS * height)
    at_head = mask[top:chin].nonzero()[:, 1].float().mean()
    below = mask.clone()
    below[:chin] = False
    places = below.nonzero()
    left = places[places[:, 1].argmin()].tolist()
    right = places[places[:, 1].argmax()].tolist()
    columns = mask[knees:].any(0).nonzero()[:, 0]
    return {
        "head": _square([top + HEAD * height / 2, float(at_head)], HEAD * height),
        "left": _square(left, HAND * height),
        "right": _square(right, HAND * height),
        "legs": (slice(knees, top + height), slice(int(columns[0]), int(columns[-1]) + 1)),
    }


def _square(middle: list[float], side: float) -> tuple[slice, slice]:
    first, second = (slice(max(round(at - side / 2), 0), max(round(at + side / 2), 1)) for at in middle)
    return first, second


def _shown(picture: np.ndarray, name: str, crop: tuple[slice, slice]) -> np.ndarray:
    """A crop of a picture, enlarged unless it shows legs."""
    times = 1 if name == "legs" else ENLARGED
    return picture[crop].repeat(times, 0).repeat(times, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoints", nargs="+", help="files, or shipped")
    parser.add_argument("--subjects", nargs="+", default=BEST_MEDIAN_WORST)
    parser.add_argument("--size", type=int, default=518, help="side of photographs in pixels")
    parser.add_argument("--refine", type=int, default=0, help="steps of optimisation of each prediction")
    parser.add_argument(
        "--set", nargs="*", default=[], help="options of the data, such as data.cache_dir=people"
    )
    parser.add_argument("--out", type=Path, default=Path("faces"))
    options = parser.parse_args()
    given = ["data=synthetic", f"data.size={options.size}", "evaluation.split=sealed", *options.set]
    data = build_data(run_of("evaluate", ["checkpoint=shipped", *given]))
    data.prepare_data(["sealed"])
    refinement = Refinement(options.refine, render) if options.refine else None
    methods = {}
    for name in options.checkpoints:
        methods[name] = ModelMethod(Predictor.from_checkpoint(name), render, refinement)
    for subject in options.subjects:
        batch = data.evaluation_batch(subject, "sealed", 4, read_option("targets", "midway"))
        target = batch.targets.images[0]
        mask = batch.targets.masks[0]
        renders = {}
        for name, method in methods.items():
            with torch.no_grad():
                image = method(batch).image[0].clamp(0, 1)
            renders[name] = image[0]
            numbers = [psnr(image, target), spill(image, target, mask), sharpness(image, target, mask)]
            print(subject, name, *(f"{float(number):.2f}" for number in numbers), flush=True)
        rows = []
        for part, crop in crops(mask[0]).items():
            tiles = [_shown(to_uint8(target[0]), part, crop)]
            captions = [f"{subject}, {part}"]
            for name, image in renders.items():
                tiles += [_shown(p, part, crop) for p in (to_uint8(image), error_map(image, target[0]))]
                captions += [Path(name).stem, "error"]
            rows.append(row(tiles, captions))
        save_png(stack(rows), options.out / f"{subject}.png")
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
