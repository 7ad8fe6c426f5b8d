"""Samples per second of the data loader, by number of workers.

    python benchmarks/loading.py                      # a miniature of THuman2.0 at its true size, 1024 x 1024
    python benchmarks/loading.py data=humman data.root=/data/humman

The arguments are the overrides of ``ghgs prepare`` for the data, ``--workers 0,1,2`` and ``--seconds 10``.
Decoded photographs are not kept, so every sample is read and decoded, as for a data set larger than the
memory. The first batch, which starts the processes, does not count.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from ghgs_lit.config import build, compose
from ghgs_lit.data.datamodule import PhotographsDataModule
from scripts.miniatures import thuman2


def build_data(overrides: list[str]) -> PhotographsDataModule:
    """The data that ``overrides`` choose, endless and without a cache."""
    cfg = compose("prepare", [*overrides, "data.cache_images_mb=0", "data.steps_per_epoch=1000000"])
    return build(cfg.data, "data", views=cfg.views, targets=cfg.targets, seed=cfg.seed)


def rate(data: PhotographsDataModule, seconds: float) -> tuple[float, int]:
    """Samples per second, and how many samples were counted."""
    batches = iter(data.train_dataloader())
    next(batches)
    started, samples = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        samples += len(next(batches).images)
    return samples / (time.perf_counter() - started), samples


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", default="0,1,2,4,8")
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--size", type=int, default=1024, help="photographs of the miniature")
    parser.add_argument("overrides", nargs="*", help="as of ghgs prepare, such as data=thuman2 data.root=...")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        overrides = arguments.overrides
        if not any(o.startswith("data.root=") for o in overrides):
            thuman2.make(Path(folder), {"train": 1}, arguments.size, 0, vids=(0, 2, 3, 4), positions=4)
            overrides = ["data=thuman2", f"data.root={folder}", *overrides]
        table = Table("workers", "samples/s", "ms per sample", "samples")
        for workers in (int(n) for n in arguments.workers.split(",")):
            data = build_data([*overrides, f"data.workers={workers}"])
            measured, samples = rate(data, arguments.seconds)
            table.add_row(str(workers), f"{measured:.1f}", f"{1000 / measured:.1f}", str(samples))
    Console().print(
        f"{data.dataset.name}, {data.dataset.size[0]} x {data.dataset.size[1]}, {os.cpu_count()} cores"
    )
    Console().print(table)


if __name__ == "__main__":
    main()
