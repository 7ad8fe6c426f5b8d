"""``ghgs prepare``: render people or scans as training data, or check a data set."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from ghgs_lit.cli.runtime import announce, output_dir
from ghgs_lit.data.check import inspect
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.data.reader import PHASES
from ghgs_lit.errors import InputError
from ghgs_lit.files import resolve_path

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Prepare

log = logging.getLogger(__name__)


def run(verb: "Prepare") -> None:
    """Render or check a data set.

    Raises:
        InputError: The configuration or the data is wrong.
    """
    data = verb.data.build(views=verb.views, targets=verb.targets, seed=verb.seed)
    root = resolve_path(data.dataset.root or ".")
    if verb.task == "render":
        render(data)
        announce(root)
    else:
        check(data, output_dir())


def render(data: PhotographsDataModule) -> None:
    """Render missing subjects, then check that all can be read.

    Args:
        data: Data module of a data set that can be rendered.

    Raises:
        InputError: The source of the data set or an existing file is wrong.
    """
    data.dataset.make()
    for phase in PHASES:
        log.info("%s: %d subjects", phase, len(data.subjects(phase)) if data.dataset.has(phase) else 0)


def check(data: PhotographsDataModule, folder: Path) -> None:
    """Read all data once, print the findings, and write ``check.json``.

    Args:
        data: Data to check.
        folder: Folder for ``check.json``.

    Raises:
        InputError: Something is missing or broken.
    """
    report = inspect(data)
    report.show()
    folder.mkdir(parents=True, exist_ok=True)
    report.write(folder / "check.json")
    announce(folder)
    if report.problems:
        name = data.dataset.name
        count = len(report.problems)
        raise InputError(f"{name}: expected nothing missing or broken; found {count} (see check.json)")
