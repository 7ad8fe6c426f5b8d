"""``ghgs doctor task=machine``: what there is, what is missing, and what the configuration needs."""

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.filesize import decimal
from rich.markup import escape
from rich.table import Table

from ghgs_lit.cli.inputs import pick_device
from ghgs_lit.config import resolve
from ghgs_lit.doctor.machine import machine_lines, memory_of_host, missing_extras
from ghgs_lit.doctor.needs import Needs, needs


def run(cfg: DictConfig) -> None:
    """Print everything; nothing is written."""
    config, console = resolve(cfg), Console(soft_wrap=True)
    device = pick_device(config["device"])
    for title, lines in (
        ("This machine", machine_lines(device)),
        ("Missing", list(missing_extras()) or [("nothing", "")]),
    ):
        table = Table("", "", title=title, title_justify="left", show_header=False, box=None)
        for line in lines:
            table.add_row(*map(escape, line))
        console.print(table)
    found = needs(config)
    console.print(_table(found))
    for line in advice(found[-1], config, _free(device)):
        console.print(line, markup=False)


def _free(device: torch.device) -> int:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else memory_of_host()[1]


def _table(found: list[Needs]) -> Table:
    table = Table(title="What the configuration needs, without activations", title_justify="left", box=None)
    for name in ("stage", "parameters", "trained", "weights", "weights and state of training"):
        table.add_column(name, justify="left" if name == "stage" else "right")
    for n in found:
        numbers = (f"{n.parameters:,}", f"{n.trained:,}", decimal(n.weights), decimal(n.training))
        table.add_row(n.stage, *numbers)
    return table


def advice(model: Needs, config: dict, free: int) -> list[str]:
    """Whether weights and training state fit into ``free`` bytes (0: not known), and keys that help."""
    if free == 0:
        return ["free memory: not known on this system"]
    lines = []
    for what, need in (("prediction", model.weights), ("training", model.training)):
        fits = "fits" if need < free else "does not fit"
        lines.append(f"{what}: {decimal(need)} of {decimal(free)} {fits} before activations")
    if model.training >= free and config["encoder"]["trainable"] != "none":
        lines.append("smaller: encoder.trainable=none (no gradient and moments of the encoder)")
    if not config["encoder"]["checkpointing"]:
        lines.append("less memory of activations in training: encoder.checkpointing=true, skip=fast")
    return lines
