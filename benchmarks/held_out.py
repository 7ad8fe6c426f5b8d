"""Each photograph of a capture held out and predicted from the others.

    python benchmarks/held_out.py photographs cameras.json model.ckpt [model.ckpt ...] --out held_out

Prints PSNR of each held-out photograph, whole and in the subject's box, for the checkpoints, the
nearest input photograph and the visual hull (splats where rays meet it), and writes pictures. The
crops and the frame of the world are those of all photographs.
"""

import argparse
import dataclasses
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import torch

from ghgs_capture import Capture
from ghgs_capture.prediction import trained_size
from ghgs_lit.cli.inputs import build_renderer, pick_device
from ghgs_lit.config import run_of
from ghgs_lit.config.options import image_size
from ghgs_lit.evaluation.baselines import nearest_view, splatted
from ghgs_lit.evaluation.baselines.splats import hull_depth
from ghgs_lit.evaluation.measure import Method, ModelMethod, measure
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.refinement import CameraRefinement, Refinement
from ghgs_lit.types import Batch, Targets
from ghgs_lit.visualization.pictures import save_png, to_uint8
from ghgs_lit.weights.checkpoint import read_checkpoint


def held_out(batch: Batch, given: Batch) -> Iterator[Batch]:
    """A batch for each photograph: that of ``given`` is the target,
    the others of ``batch`` the inputs."""
    count = batch.masks.shape[1]
    for i in range(count):
        others = [j for j in range(count) if j != i]
        name = ((batch.views[0][i],),)
        targets = Targets(
            given.images[:, [i]], given.masks[:, [i]], batch.cameras[:, [i]], name, protocols=("held_out",)
        )
        yield dataclasses.replace(batch.of_views(others), targets=targets)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path)
    parser.add_argument("cameras", type=Path)
    parser.add_argument("checkpoints", type=Path, nargs="+")
    parser.add_argument("--size", type=int, help="side of the crops in pixels; none: the first checkpoint's")
    parser.add_argument("--refine", type=int, default=0, help="steps of optimisation of each prediction")
    parser.add_argument(
        "--refine-masks", type=int, default=0, help="pixels that masks of inputs may be off by"
    )
    parser.add_argument("--refine-cameras", type=int, default=0, help="rounds that correct all cameras first")
    parser.add_argument("--out", type=Path, default=Path("held_out"))
    options = parser.parse_args()
    run = run_of("evaluate", ["data=synthetic"])
    device = pick_device(run.device)
    renderer, metrics = build_renderer(run, device), run.metrics.build().to(device)
    size = options.size or trained_size(read_checkpoint(options.checkpoints[0])["config"])
    capture, size = Capture.read(options.images, options.cameras), image_size("size", size)
    # Targets are as their masks have them, whatever the inputs are.
    batch, given = capture.batch(size, options.refine_masks), capture.batch(size).to(device)
    batch = Frame.of(batch).enter(batch)  # baselines compute in float32
    methods: dict[str, Method] = {
        "nearest view": nearest_view,
        "visual hull": partial(splatted, depth_of=hull_depth, renderer=renderer),
    }
    refinement = Refinement(options.refine, renderer) if options.refine else None
    for path in options.checkpoints:
        methods[str(path)] = ModelMethod(Predictor.from_checkpoint(path, device), renderer, refinement)
    # by the first checkpoint, from all photographs: the calibration is theirs
    if options.refine_cameras:
        model = methods[str(options.checkpoints[0])].model
        batch = CameraRefinement(options.refine_cameras, model, renderer)(batch.to(device))
    rows = []
    with torch.no_grad():
        for one in held_out(batch.to(device), given):
            images = [one.targets.images[0, 0]]
            for name, method in methods.items():
                rows += measure(method, name, [one], metrics, device)
                images.append(method(one).image[0, 0])
            save_png(to_uint8(torch.cat(images, -1)), options.out / f"{one.targets.names[0][0]}.png")
    print("| held out | " + " | ".join(methods) + " |\n|---" + "|---" * len(methods) + "|")
    for name in batch.views[0]:
        own = [row for row in rows if row["target"] == name]
        print(f"| {name} | " + " | ".join(f"{row['psnr']:.2f} / {row['psnr_box']:.2f}" for row in own) + " |")
    print(f"PSNR in dB, whole / in the box; pictures (truth, then these columns): {options.out}")


if __name__ == "__main__":
    main()
