"""``ghgs doctor``: diagnose cameras, this machine or a device; one function for each task."""

import os
from typing import TYPE_CHECKING

import rich
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ghgs_capture.calibration import calibrate
from ghgs_capture.camera_report import diagnose
from ghgs_capture.capture import Capture
from ghgs_capture.drawing import camera_sheet
from ghgs_capture.formats.json_and_toml import json_text
from ghgs_capture.prediction import predict
from ghgs_capture.tones import tone_lines
from ghgs_capture.verbs.photographs import capture_folder
from ghgs_lit.cli.inputs import pick_device
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.diagnostics.doctor.selfcheck import FAILED, selfcheck, table
from ghgs_lit.diagnostics.machine import machine_lines, missing_extras
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_text_atomically
from ghgs_lit.visualization.pictures import save_png

if TYPE_CHECKING:
    from ghgs_capture.verbs import Doctor

_LISTED = 6  #: Number of interpretations of a calibration that are listed


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

    Writes ``cameras.png``, and ``cameras.json`` where another interpretation of the calibration
    fits.

    Args:
        run: as configured.

    Raises:
        InputError: the cameras do not fit the masks, or a file is missing or wrong.
    """
    tasks = "images=<folder of photographs> cameras=<calibration>, task=machine or task=selfcheck"
    require(run.images is not None, "images", tasks, None)
    directory = output_dir()
    write_config(run, directory)
    folder = capture_folder(run)
    inputs = {os.path.realpath(path) for path in folder.input_files}
    picture = directory / "cameras.png"
    calibration = directory / "cameras.json"
    for path in (picture, calibration):
        expected = "a folder (hydra.run.dir) without inputs"
        require(os.path.realpath(path) not in inputs, str(path), expected, "an input")
    diagnosis = diagnose(folder)
    best = diagnosis.ranking[0]
    listing = Table("meaning", "worst agreement", *best.shares)
    for hypothesis in diagnosis.ranking[:_LISTED]:
        shares = (f"{share:.0%}" for share in hypothesis.shares.values())
        listing.add_row(hypothesis.says, f"{hypothesis.score:.0%}", *shares)
    rich.print(listing)
    print("\n".join(diagnosis.lines), flush=True)
    views = best.views
    if diagnosis.consistent:
        capture = Capture(folder.instants[0], folder.photographs(folder.instants[0]))
        tones = predict(capture, refine_cameras=0, refine_masks=0).tones
        for line in tone_lines(tones, "which ghgs predict undoes"):
            print(line, flush=True)
    if best.score > 0:
        images = [photograph.image for photograph in best.photographs(folder)]
        save_png(camera_sheet([v.name for v in views], images, best.silhouettes(folder)), picture)
        announce(picture)
    if diagnosis.option and "exif" not in diagnosis.option:  # of stored pixels, which no file says
        best_cameras = {
            v.name: (calibrate(v.camera, v.convention, v.camera.size), v.camera.size) for v in views
        }
        write_text_atomically(calibration, json_text(best_cameras))
        announce(calibration)
    if not diagnosis.consistent:
        problems = "; ".join(diagnosis.lines)
        raise InputError(f"{run.cameras}: expected cameras that fit the masks; found {problems}")


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
