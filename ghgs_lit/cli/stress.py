"""``ghgs stress``: every stage on adversarial inputs, against float64; or one saved training step again."""

import sys

from omegaconf import DictConfig
from rich.console import Console
from rich.table import Table

from ghgs_lit.cli.inputs import choices
from ghgs_lit.cli.runtime import announce, output_dir, save_config
from ghgs_lit.diagnostics.stress import report
from ghgs_lit.diagnostics.stress.run import processes, run_tasks, tasks_of
from ghgs_lit.runs.provenance import provenance
from ghgs_lit.training.replay import replay


def run(cfg: DictConfig) -> None:
    """The verb; prints the path of the results last. Exit code 1 where a budget or a step is broken."""
    directory = output_dir()
    config = save_config(cfg, directory)
    if config["dump"] is not None:
        return _replay(config["dump"])
    tasks = tasks_of(config["stages"], config["families"], config["dtypes"], config["quick"])
    rows = run_tasks(tasks, directory / "cells.jsonl", processes(config["workers"]))
    _print(rows)
    source = provenance(config, seed=0, verb="stress", choices=choices())
    announce(report.write(directory, rows, source))
    failed = [row for row in rows if row["failures"]]
    for row in failed:
        found = "no bound" if row["error"] is None else f"{row['error']:.3g}"
        place = f"{row['stage']}, {row['family']}, {row['dtype']}"
        print(
            f"ghgs stress: {place}: expected an error of at most {row['budget']:g}; found {found} in"
            f" {row['failures']} of {row['cases']} cases ({row['worst']})",
            file=sys.stderr,
        )
    if failed:
        raise SystemExit(1)


def _replay(path: str) -> None:
    """Print what is wrong with a saved step; exit code 1 where it still is."""
    step, recorded, fault = replay(path)
    print(f"step {step}, when it was saved: {recorded}")
    print(f"step {step}, now: {fault or 'all values are finite'}")
    if fault is not None:
        raise SystemExit(1)


def _print(rows: list[report.Row]) -> None:
    """The worst error of each stage, by dtype."""
    found = report.summary(rows)
    worst = {(row["stage"], row["dtype"]): row for row in found["worst"]}
    dtypes = list(dict.fromkeys(row["dtype"] for row in rows))
    table = Table(
        "stage", "cases", "budget", *dtypes, title=f"{found['cases']} cases, {found['failures']} failures"
    )
    for stage in dict.fromkeys(row["stage"] for row in rows):
        own = [row for row in rows if row["stage"] == stage]
        cells = []
        for dtype in dtypes:
            row = worst.get((stage, dtype))
            cells.append(
                "-" if row is None else "no bound" if row["error"] is None else f"{row['error']:.2g}"
            )
        table.add_row(stage, str(sum(row["cases"] for row in own)), f"{own[0]['budget']:g}", *cells)
    Console(width=max(Console().width, 100)).print(table)
