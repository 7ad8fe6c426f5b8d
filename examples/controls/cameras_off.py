"""Measure the runs of a sweep again, with errors of some pixels in the input cameras but exact targets.

    export GHGS_PLUGINS=examples/controls/controls.py
    python examples/controls/cameras_off.py runs/train/controls runs/controls_off --pixels 3
    ghgs table runs=runs/controls_off

A person's cameras are the same in all runs. Runs with results are skipped.
"""

import argparse
import dataclasses
from pathlib import Path

import torch

from ghgs_lit.cli import inputs
from ghgs_lit.cli.evaluate import trained_method
from ghgs_lit.config import run_of
from ghgs_lit.config.registry import load_plugins
from ghgs_lit.data.augmentation import Augmentation
from ghgs_lit.data.sampling import subject_rng
from ghgs_lit.evaluation.report import measure_and_write
from ghgs_lit.types import Batch


def measure_run(checkpoint: Path, directory: Path, pixels: float) -> None:
    """Measure a checkpoint on the people of its validation and write ``metrics.json``.

    Args:
        checkpoint: Of a training with true depths.
        directory: Folder of the results.
        pixels: Largest error of a camera in pixels of the images, above 0.
    """
    keys = [f"checkpoint={checkpoint}", "metrics.lpips=off", "evaluation.pictures=0", "device=cpu"]
    run = inputs.with_chosen_targets(inputs.with_trained_data(run_of("evaluate", keys)))
    run = run.replace(**inputs.model_of(run.checkpoint, run))
    method, facts = trained_method(run, torch.device("cpu"))
    error = Augmentation(calibration=pixels)

    def add_errors(batch: Batch) -> Batch:
        return error.add_imperfections(batch, [subject_rng(0, subject) for subject in batch.subjects])

    methods = {"model": dataclasses.replace(method, cameras=add_errors)}
    data = inputs.build_data(run)
    facts |= {"verb": "evaluate", "checkpoint": str(checkpoint)}
    measure_and_write(methods, data, run, directory, torch.device("cpu"), **facts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sweep", type=Path, help="with finished runs")
    parser.add_argument("out", type=Path, help="where results go, a folder for each run")
    parser.add_argument("--pixels", type=float, default=3.0, help="greatest error of a camera")
    options = parser.parse_args()
    load_plugins()
    for metrics in sorted(options.sweep.glob("*/metrics.json")):
        directory = options.out / metrics.parent.name
        if not (directory / "metrics.json").exists():
            directory.mkdir(parents=True, exist_ok=True)
            measure_run(metrics.parent / "checkpoints" / "last.ckpt", directory, options.pixels)


if __name__ == "__main__":
    main()
