"""``ghgs doctor``: diagnose cameras, this machine or a device; one function for each task."""

from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ghgs_capture.camera_report import diagnose
from ghgs_capture.verbs.photographs import capture_folder
from ghgs_lit.cli.inputs import pick_device
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.diagnostics.doctor.selfcheck import FAILED, selfcheck, table
from ghgs_lit.diagnostics.machine import machine_lines, missing_extras
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_text_atomically

if TYPE_CHECKING:
    from ghgs_capture.verbs import Doctor


def run(verb: "Doctor") -> None:
    """Run the task of the verb.

    Args:
        verb: the run.

    Raises:
        InputError: as for the task.
    """
    tasks = {"cameras": cameras, "machine": machine, "selfcheck": selfcheck_device}
    tasks[verb.task](verb)


def cameras(run: "Doctor") -> None:
    """Check whether photographs, masks and calibration fit together.

    Args:
        run: as configured.

    Raises:
        InputError: the cameras do not fit the masks, or a file is missing or wrong.
    """
    tasks = "images=<folder of photographs> cameras=<calibration>, task=machine or task=selfcheck"
    require(run.images is not None, "images", tasks, None)
    write_config(run, output_dir())
    diagnosis = diagnose(capture_folder(run))
    if not diagnosis.consistent:
        problems = "; ".join(diagnosis.lines)
        raise InputError(f"{run.cameras}: expected cameras that fit the masks; found {problems}")
    print("\n".join(diagnosis.lines), flush=True)


def machine(run: "Doctor") -> None:
    """Print what this machine has and which features lack a package or device.

    Args:
        run: names the device.
    """
    console = Console(soft_wrap=True)
    for title, lines in (
        ("This machine", machine_lines(pick_device(run.device))),
        ("Extras that are not installed", list(missing_extras()) or [("none", "")]),
    ):
        listing = Table("", "", title=title, title_justify="left", show_header=False, box=None)
        for line in lines:
            listing.add_row(*map(escape, line))
        console.print(listing)


def selfcheck_device(run: "Doctor") -> None:
    """Check whether a device computes as the CPU does.

    Prints each outcome, and writes all of them with facts of the machine to ``selfcheck.md``.

    Args:
        run: as configured.

    Raises:
        InputError: a check failed.
    """
    device = pick_device(run.device)
    outcomes = []
    for outcome in selfcheck(run, device):
        outcomes.append(outcome)
        print(f"{outcome.status} {outcome.check}: {outcome.found}", flush=True)
    facts = "\n".join(f"- {name}: {value}" for name, value in machine_lines(device))
    path = output_dir() / "selfcheck.md"
    write_text_atomically(path, f"{facts}\n\n{table(outcomes)}\n")
    announce(path)
    failed = [outcome.check for outcome in outcomes if outcome.status == FAILED]
    if failed:
        raise InputError(f"selfcheck: expected no failed check; found {len(failed)}: {', '.join(failed)}")
