"""Times of training samples: from the data's own files, kept in memory and packed; as they are and imperfect.

    python benchmarks/loading.py                      # a miniature of THuman2.0 at its true size, 1024 x 1024
    python benchmarks/loading.py experiment=shipped 'data.people={train: 8, val: 1}' 'data.active={train: 0}'
    python benchmarks/loading.py data=humman data.root=/data/humman --workers 4,8

The arguments are the overrides of ``ghgs train``, ``--workers 0,1,2``, ``--seconds 10`` and ``--size``. The
first table has the processor time of one process without workers: with ``own files`` every photograph is read
and decoded in each sample, as for a data set larger than the memory; ``kept in memory`` has them all decoded.
The second one has samples per second of packed photographs by number of workers.
"""

import argparse
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).parents[1]))

from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import run_of
from ghgs_lit.data.datamodule import PhotographsDataModule
from scripts.miniatures import thuman2

ENDLESS = ("data.steps_per_epoch=1000000", "augmentation.exact_from=null")
SOURCES = {
    "own files": ("data.packed_gb=0", "data.cache_images_mb=0"),
    "kept in memory": ("data.packed_gb=0", "data.cache_images_mb=100000"),
    "packed": ("data.packed_gb=1000",),
}
#: Sizes are those of the data in both, for comparison.
KINDS = {
    "as they are": ("augmentation=none", "augmentation.chance=0"),
    "imperfect": (
        "augmentation=captures",
        "augmentation.chance=1",
        "augmentation.sizes=null",
        "augmentation.target_scale=null",
    ),
    "imperfect, sizes vary": ("augmentation=captures", "augmentation.chance=1"),
}
_PARTS = 5  #: of a measurement, of which the median counts


def data_of(overrides: list[str]) -> PhotographsDataModule:
    """The data module that ``ghgs train`` makes of these overrides."""
    return build_data(run_of("train", [*overrides, *ENDLESS]))


def rate(data: PhotographsDataModule, seconds: float) -> tuple[float, int]:
    """Samples per second, and how many samples were counted; the first batch, which starts the
    processes, does not count."""
    batches = iter(data.train_dataloader())
    next(batches)
    started, samples = time.perf_counter(), 0
    while time.perf_counter() - started < seconds:
        samples += len(next(batches).images)
    return samples / (time.perf_counter() - started), samples


def processor_ms(data: PhotographsDataModule, seconds: float) -> float:
    """Milliseconds of processor time of a sample in this process, the median of some parts
    of ``seconds``. Each subject was read before, and all of its photographs where they are
    kept in memory."""
    batches = data.train_dataloader().dataset
    photographs = batches.builder.inputs
    for name, positions in photographs.reader.subjects.items():
        chosen = positions if photographs.cache_bytes else positions[:1]
        for position in chosen:
            for view in {0, *data.targets.training_views} if photographs.cache_bytes else {0}:
                photographs.view(name, position, view, batches.builder.depths)
    found, step = [], 0
    for _ in range(_PARTS):
        started, first = time.process_time(), step
        while time.process_time() - started < seconds / _PARTS:
            batches[step]
            step += 1
        samples = (step - first) * data.dataset.batch_size
        found.append(1e3 * (time.process_time() - started) / samples)
    return statistics.median(found)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--workers", default="0,1,2,4,8")
    parser.add_argument("--seconds", type=float, default=5)
    parser.add_argument("--size", type=int, default=1024, help="photographs of the miniature")
    parser.add_argument("overrides", nargs="*", help="as of ghgs train, such as data=thuman2 data.root=...")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        overrides = arguments.overrides
        if not any(o.startswith(("data", "experiment")) for o in overrides):
            thuman2.make(Path(folder), {"train": 1}, arguments.size, 0, vids=(0, 2, 3, 4), positions=4)
            overrides = ["data=thuman2", f"data.root={folder}", "views.training_counts=[4]", *overrides]
        own = Table("photographs", *KINDS, title="processor time of a sample in ms, no workers")
        data_of(overrides).prepare_data()
        for source, chosen in SOURCES.items():
            row = []
            for kind in KINDS.values():
                data = data_of([*kind, *overrides, *chosen, "data.workers=0"])
                row.append(f"{processor_ms(data, arguments.seconds):.1f}")
            own.add_row(source, *row)
        table = Table("workers", "samples/s", "ms per sample", "samples", title="packed, as they are")
        for workers in (int(n) for n in arguments.workers.split(",") if n):
            data = data_of([*overrides, *KINDS["as they are"], f"data.workers={workers}"])
            measured, samples = rate(data, arguments.seconds)
            table.add_row(str(workers), f"{measured:.1f}", f"{1000 / measured:.1f}", str(samples))
    size = data.dataset.size
    Console().print(f"{data.dataset.name}, {size[0]} x {size[1]}, {os.cpu_count()} cores")
    Console().print(own)
    Console().print(table)


if __name__ == "__main__":
    main()
