"""Sections of ``benchmarks/gpu.py`` that need people: their rendering, the loader, a training."""

import contextlib
import csv
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.gpu_measure import Call
from ghgs_lit.cli.inputs import build_data
from ghgs_lit.data.datamodule import PhotographsDataModule

_EIGHT = 8  #: samples of a training step


def people(call: Call) -> None:
    """Rendering of built-in people"""
    for train, active, val in call.sizes.people:
        started = time.perf_counter()
        _data(call, train, active, val).prepare_data()
        call.add(f"{train + active} people", numbers=[train, active, val], s=time.perf_counter() - started)


def _numbers(train: int, active: int, val: int) -> list[str]:
    return [f"data.people={{train: {train}, val: {val}}}", f"data.active={{train: {active}, val: 0}}"]


def _data(call: Call, train: int, active: int, val: int, *overrides: str) -> PhotographsDataModule:
    return build_data(call.run(*call.shipped, *_numbers(train, active, val), *overrides))


def loader(call: Call) -> None:
    """Batches of eight for experiment=shipped from the loader"""
    numbers = call.rendered
    for workers in call.sizes.workers:
        options = ["data.batch_size=8", f"data.workers={workers}", "data.steps_per_epoch=100000"]
        found, samples = rate(_data(call, *numbers, *options), call.sizes.seconds)
        call.add(f"{workers} workers", samples_s=found, ms_sample=1e3 / found, samples=samples)


def rate(data: PhotographsDataModule, seconds: float) -> tuple[float, int]:
    """Samples per second, and the number of counted samples; the first batch, which starts the
    workers, is excluded."""
    batches = iter(data.train_dataloader())
    next(batches)
    started, samples = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        samples += len(next(batches).images)
    return samples / (time.perf_counter() - started), samples


def training(call: Call) -> None:
    """Training of experiment=shipped with batches of eight: validations"""
    folder, started, known = call.work / "training", time.perf_counter(), 0
    shutil.rmtree(folder, ignore_errors=True)
    workers = max((os.cpu_count() or 2) - 2, 1) if call.gpu.is_real else 0
    options = ["trainer=gpu", f"data.batch_size={_EIGHT}", f"data.workers={workers}", "trainer.max_steps=-1"]
    options += ["trainer.limit_val_batches=2", "augmentation.exact_from=null"]
    options += ["evaluation.views=[4]", "evaluation.targets=[release]", "evaluation.pictures=0"]
    options += [*_numbers(*call.rendered), f"hydra.run.dir={folder}"]
    options += [*call.sizes.training, *call.overrides]
    command = [sys.executable, "-m", "ghgs_lit", "train", *call.shipped, *options]
    with subprocess.Popen(command) as process:
        ended = False
        while not ended:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(3)
            ended = process.returncode is not None
            rows = validations(folder / "csv" / "metrics.csv")
            for row in rows[known:]:
                samples, s = _EIGHT * row.pop("step"), time.perf_counter() - started
                call.add(f"{samples:.0f} samples", samples=samples, s=s, **row)
            known = len(rows)
    if process.returncode:
        raise RuntimeError(f"ghgs train ended with {process.returncode}")


def validations(file: Path) -> list[dict[str, float]]:
    """Scores of the validations in a run's CSV file, with their steps."""
    if not file.exists():
        return []
    with file.open(newline="") as lines:
        rows = [row for row in csv.DictReader(lines) if row.get("val/psnr")]
    names = ("psnr", "psnr_box", "ssim", "depth_error_mm")
    found = []
    for row in rows:
        scores = {name: float(row[f"val/{name}"]) for name in names if row.get(f"val/{name}")}
        found.append({"step": float(row["step"]), **scores})
    return found
