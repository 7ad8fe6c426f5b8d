"""``ghgs doctor task=machine``: what there is, and what is missing."""

from omegaconf import DictConfig
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ghgs_lit.cli.inputs import pick_device
from ghgs_lit.config import resolve
from ghgs_lit.diagnostics.doctor.machine import machine_lines, missing_extras


def run(cfg: DictConfig) -> None:
    """Print everything; nothing is written."""
    console = Console(soft_wrap=True)
    for title, lines in (
        ("This machine", machine_lines(pick_device(resolve(cfg)["device"]))),
        ("Missing", list(missing_extras()) or [("nothing", "")]),
    ):
        table = Table("", "", title=title, title_justify="left", show_header=False, box=None)
        for line in lines:
            table.add_row(*map(escape, line))
        console.print(table)
