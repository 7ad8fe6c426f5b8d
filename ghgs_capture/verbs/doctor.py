"""``ghgs doctor``: diagnose cameras or this machine, with one function for each task."""

from typing import TYPE_CHECKING

from ghgs_capture.camera_report import diagnose
from ghgs_capture.verbs.photographs import capture_folder
from ghgs_lit.cli.inputs import pick_device
from ghgs_lit.cli.runtime import output_dir, write_config
from ghgs_lit.diagnostics.machine import machine_lines
from ghgs_lit.errors import InputError, require

if TYPE_CHECKING:
    from ghgs_capture.verbs import Doctor


def run(verb: "Doctor") -> None:
    """Run the task of the verb.

    Raises:
        InputError: from the task.
    """
    tasks = {"cameras": cameras, "machine": machine}
    tasks[verb.task](verb)


def cameras(run: "Doctor") -> None:
    """Check whether photographs, masks and calibration fit together.

    Raises:
        InputError: the cameras do not fit the masks, or a file is missing or wrong.
    """
    tasks = "images=<folder of photographs> cameras=<calibration>, or task=machine"
    require(run.images is not None, "images", tasks, None)
    write_config(run, output_dir())
    diagnosis = diagnose(capture_folder(run))
    if not diagnosis.consistent:
        raise InputError(f"{run.cameras}: expected cameras that fit the masks; found {diagnosis.line}")
    print(diagnosis.line, flush=True)


def machine(run: "Doctor") -> None:
    """Print what this machine has, for ``run.device``."""
    for name, text in machine_lines(pick_device(run.device)):
        print(f"{name:18}{text}")
