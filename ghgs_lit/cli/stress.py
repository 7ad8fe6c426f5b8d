"""``ghgs stress``: compare stages with float64 on adversarial inputs."""

import sys
from typing import TYPE_CHECKING

from ghgs_lit.cli.inputs import choices
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.diagnostics.output import print_tables
from ghgs_lit.diagnostics.stress import report
from ghgs_lit.diagnostics.stress.run import run_tasks, tasks_of
from ghgs_lit.errors import require
from ghgs_lit.runs.provenance import provenance
from ghgs_lit.runtime.cores import allowed_cores

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Stress


def run(verb: "Stress") -> None:
    """Compare stages with float64 and write the report.

    Args:
        verb: the run.

    Raises:
        InputError: there is no such stage or family.
        SystemExit: code 1: an error exceeds its budget.
    """
    directory = output_dir()
    write_config(verb, directory)
    tasks = tasks_of(verb.stages, verb.families, verb.quick)
    require(bool(tasks), "families", "a family that one of the stages has", verb.families)
    rows = run_tasks(tasks, allowed_cores() if verb.workers is None else verb.workers)
    print_tables(report.tables_of(rows))
    print(report.counts_of(rows))
    source = provenance(verb.plain, seed=0, verb="stress", choices=choices())
    announce(report.write(directory, rows, source))
    failed = [row for row in rows if row["failures"]]
    for row in failed:
        cell = f"{row['stage']}, {row['family']}, {row['dtype']}"
        print(
            f"ghgs stress: {cell}: expected an error of at most {row['budget']:g}; found"
            f" {report.bounded(row['error'])} in {row['failures']} of {row['cases']} cases ({row['worst']})",
            file=sys.stderr,
        )
    if failed:
        raise SystemExit(1)
