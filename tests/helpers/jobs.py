"""Sweeps without training, whose runs only record their execution, in this process or others."""

import os
import time
from pathlib import Path
from typing import Any

import hydra

from ghgs_lit.cli.runtime import output_dir
from ghgs_lit.config import VERSION_BASE, conf_dir, run_of
from ghgs_lit.config.compose import to_plain
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.reading import reading_as_ghgs
from ghgs_lit.config.registry import verb_class
from ghgs_lit.config.run import Run
from ghgs_lit.runs import job as job_module
from ghgs_lit.runs.job import register_resolvers, train_once
from ghgs_lit.runs.results import config_hash, provenance, write_results
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.runs.sweep import PlannedRun, run_all

register_resolvers()


def write_finished_run(directory: Path, config: dict[str, Any], psnr: float = 20.0, **facts: Any) -> float:
    """Write the results of a run, with further facts of its provenance."""
    row = {"method": "model", "subject": "p0", "views": 4, "targets": "release", "target": "0", "inputs": []}
    write_results(directory, [{**row, "psnr": psnr}], provenance(config, seed=config["seed"], **facts))
    return psnr


def record_execution(run: Run, directory: Path, stats: dict[str, Any]) -> float:
    """Instead of training, write one line to the sweep's file ``executed``."""
    with open(directory.parent / "executed", "a") as file:
        file.write(f"{directory.name} {os.getpid()} {run.resume}\n")
    stats |= {"steps": 10, "seconds": 5.0}
    return write_finished_run(directory, run.plain, 20.0 + run.optimizer.lr)


def rehearse_nothing(monkeypatch) -> None:
    """Make ``dry_run`` rehearse nothing, for tests of the plan only."""
    monkeypatch.setattr("ghgs_lit.cli.rehearsal.rehearse", lambda planned: [])


def executed(sweep: Path) -> list[str]:
    """Names of the runs in the order of execution."""
    path = sweep / "executed"
    return [line.split()[0] for line in path.read_text().splitlines()] if path.exists() else []


def job(cfg) -> float | str | None:
    """The job of a launcher: the verb without training; ``data.workers`` loads data, as in training."""
    return train_once(
        RunDirectory(output_dir()), verb_class("train").of(to_plain(fill(cfg))), load_and_record
    )


def load_and_record(run: Run, directory: Path, stats: dict[str, Any]) -> float:
    """:func:`record_execution` after two batches."""
    if run.data.workers != "auto":
        from ghgs_lit.data.batches import make_loader

        assert list(make_loader([1, 2], run.data.workers)) == [1, 2]
    return record_execution(run, directory, stats)


def hydra_app(monkeypatch, *overrides: str) -> None:
    """Run ``job`` as an application with ``conf/train.yaml``."""
    monkeypatch.setattr("sys.argv", ["ghgs", *overrides])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with reading_as_ghgs():
        hydra.main(**VERSION_BASE, config_path=str(conf_dir()), config_name="train")(job)()


def plan_seeds(sweep: Path, count: int) -> list[PlannedRun]:
    """A grid of ``count`` seeds."""
    base = run_of("train", ["resume=null", "optimizer.lr=1.0"])
    planned = []
    for seed in range(count):
        run = base.replace(seed=seed)
        name = config_hash(run.plain)
        planned.append(PlannedRun((str(seed),), run, RunDirectory(sweep / name, name)))
    return planned


def work_through(sweep: Path, count: int, barrier) -> None:
    """One of several processes that work on the same grid, run by run."""
    job_module.in_sweep = lambda: True
    items = plan_seeds(sweep, count)

    def slow(run, directory, stats):
        time.sleep(0.05)
        return record_execution(run, directory, stats)

    def launch(jobs, first):
        from hydra.core.utils import JobReturn, JobStatus

        picked = [items[int(overrides[0])] for overrides in jobs]
        values = [train_once(item.directory, item.run, slow) for item in picked]
        return [JobReturn(_return_value=value, status=JobStatus.COMPLETED) for value in values]

    barrier.wait()
    run_all(items, launch)
    (sweep / f"seen_{os.getpid()}").write_text(str(sum(item.directory.done for item in items)))


def hold_run(directory: Path, ready) -> None:
    """Lock a run until the process is killed, a minute at most."""
    with RunDirectory(directory).claim() as mine:
        assert mine
        ready.set()
        time.sleep(60)
