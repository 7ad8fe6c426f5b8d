"""Sweeps whose runs only note that they were executed: for tests, here and in other processes."""

import os
import time
from pathlib import Path
from typing import Any

import hydra

from ghgs_lit.cli.runtime import output_dir, plain
from ghgs_lit.config import conf_dir
from ghgs_lit.runs.grid import carry_out
from ghgs_lit.runs.job import register_resolvers, work_on
from ghgs_lit.runs.plan import Planned
from ghgs_lit.runs.provenance import config_hash, provenance
from ghgs_lit.runs.results import write_results
from ghgs_lit.runs.run import Run

register_resolvers()


def finish(directory: Path, config: dict[str, Any], psnr: float = 20.0) -> float:
    """Write the results of a run."""
    row = {"method": "model", "subject": "p0", "views": 4, "targets": "release", "target": "0", "inputs": []}
    write_results(directory, [{**row, "psnr": psnr}], provenance(config, seed=config["seed"]))
    return psnr


def noting(config: dict[str, Any], directory: Path, notes: dict[str, Any]) -> float:
    """In place of training: one line in the sweep's ``executed``."""
    with open(directory.parent / "executed", "a") as file:
        file.write(f"{directory.name} {os.getpid()} {config['resume']}\n")
    notes |= {"steps": 10, "seconds": 5.0}
    return finish(directory, config, 20.0 + config["optimizer"]["lr"])


def executed(sweep: Path) -> list[str]:
    """Names of the runs in the order in which they were executed."""
    path = sweep / "executed"
    return [line.split()[0] for line in path.read_text().splitlines()] if path.exists() else []


def job(cfg) -> float | str | None:
    """What a launcher starts: the verb without its training."""
    return work_on(Run(output_dir()), plain(cfg), noting)


def hydra_app(monkeypatch, *overrides: str) -> None:
    """Run ``job`` as an application over ``conf/train.yaml``."""
    monkeypatch.setattr("sys.argv", ["ghgs", *overrides])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="train")(job)()


def planned_by_hand(sweep: Path, count: int) -> list[Planned]:
    configs = [{"seed": s, "resume": None, "optimizer": {"lr": 0.0}} for s in range(count)]
    names = [config_hash(config) for config in configs]
    return [
        Planned(n, (str(i),), (), c, Run(sweep / n))
        for i, (n, c) in enumerate(zip(names, configs, strict=True))
    ]


def work_through(sweep: Path, count: int, barrier) -> None:
    """One of several processes that work on the same grid, one run after another."""
    os.environ["GHGS_SWEEP_JOB"] = "skip"
    items = planned_by_hand(sweep, count)

    def slow(config, directory, notes):
        time.sleep(0.05)
        return noting(config, directory, notes)

    def launch(jobs, first):
        from hydra.core.utils import JobReturn, JobStatus

        picked = [items[int(overrides[0])] for overrides in jobs]
        values = [work_on(item.run, dict(item.config), slow) for item in picked]
        return [JobReturn(_return_value=value, status=JobStatus.COMPLETED) for value in values]

    barrier.wait()
    carry_out(items, launch)
    (sweep / f"seen_{os.getpid()}").write_text(str(sum(item.run.done for item in items)))


def hold(directory: Path, ready, release=None) -> None:
    """Take a run and keep it until told, or killed."""
    with Run(directory).claim() as mine:
        assert mine
        ready.set()
        release.wait() if release is not None else time.sleep(60)
