"""``ghgs doctor task=machine``: what there is, what is missing, and what the configuration needs."""

import copy
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import torch
from omegaconf import DictConfig
from rich.console import Console
from rich.filesize import decimal
from rich.markup import escape
from rich.table import Table

from ghgs_lit.cli.inputs import pick_device
from ghgs_lit.config import resolve
from ghgs_lit.config.settings import image_size
from ghgs_lit.diagnostics.benchmark.stages import RENDER, TOTAL
from ghgs_lit.diagnostics.doctor.estimate import (
    BACKWARD,
    LOSS,
    Pass,
    Scene,
    estimate_prediction,
    estimate_training,
)
from ghgs_lit.diagnostics.doctor.machine import machine_lines, memory_of_host, missing_extras
from ghgs_lit.diagnostics.doctor.needs import needs
from ghgs_lit.model import STAGES

#: Of the products, by ``trainer.precision``.
_PRECISIONS = {"bf16-mixed": "bfloat16", "16-mixed": "float16"}

#: What a key that makes memory smaller changes in a configuration.
Change = Callable[[dict], None]


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
    kind = "cuda" if config["gpu_memory"] is not None else device.type
    prediction, step = predicted(config, kind), trained(config, kind)
    scene, batch = _scene(config), config["data"]["batch_size"]
    console.print(
        f"What the configuration needs: {scene.views} views of {scene.size[0]} x {scene.size[1]},"
        f" the subject on {scene.share:.0%} of the frame; batches of {batch} in training"
    )
    console.print(_table(config, prediction, step))
    weights, state = decimal(prediction.held), decimal(step.held)
    console.print(
        f"every figure of memory includes the weights, {weights}; in training AdamW's moments: {state}"
    )
    free = _free(device) if config["gpu_memory"] is None else int(1e9 * config["gpu_memory"])
    for line in advice(config, kind, prediction, step, free):
        console.print(line, markup=False)


def predicted(config: Mapping[str, Any], kind: str) -> Pass:
    """A prediction of one subject in float32."""
    return estimate_prediction(config, _scene(config), kind, "float32")


def trained(config: Mapping[str, Any], kind: str) -> Pass:
    """A step of training with the batch and the precision of the configuration."""
    scene = dataclasses.replace(
        _scene(config),
        views=max(config["views"]["training_counts"]),
        batch=config["data"]["batch_size"],
        targets=config["targets"]["per_step"],
    )
    precision = _PRECISIONS.get(str(config["trainer"]["precision"]), "float32")
    return estimate_training(config, scene, kind, precision)


def _scene(config: Mapping[str, Any]) -> Scene:
    size = image_size("data.size", config["data"]["size"])
    return Scene(config["share"], config["views"]["evaluation_count"], size)


def _free(device: torch.device) -> int:
    return torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else memory_of_host()[1]


def _table(config: Mapping[str, Any], prediction: Pass, step: Pass) -> Table:
    """Parameters, products and memory by stage."""
    table = Table(box=None)
    heads = (
        "stage",
        "parameters",
        "trained",
        "prediction: GFLOP",
        "memory",
        "training step: GFLOP",
        "memory",
    )
    for name in heads:
        table.add_column(name, justify="left" if name == "stage" else "right")
    sizes = {n.stage: (f"{n.parameters:,}", f"{n.trained:,}") for n in needs(config)}
    sizes[TOTAL] = sizes["model"]
    for name in (*STAGES, RENDER, LOSS, BACKWARD, TOTAL):
        cells = []
        for found in (prediction, step):
            known = name in found.peaks
            gigaflops = f"{found.flops[name] / 1e9:,.1f}" if known else ""
            cells += [gigaflops, decimal(found.held + found.peaks[name]) if known else ""]
        table.add_row(name, *sizes.get(name, ("", "")), *cells)
    return table


def advice(config: Mapping[str, Any], kind: str, prediction: Pass, step: Pass, free: int) -> list[str]:
    """Whether both fit into ``free`` bytes (0: not known), and the keys that make them."""
    if free == 0:
        return ["free memory: not known on this system; give gpu_memory=<GB>"]
    lines = []
    for what, need, again in (("prediction", prediction, predicted), ("training step", step, trained)):
        fits = need.bytes < free
        lines.append(f"{what}: {decimal(need.bytes)} of {decimal(free)} {'fits' if fits else 'does not fit'}")
        if not fits:
            lines += _smaller(config, kind, again, free)
    return lines


def _smaller(
    config: Mapping[str, Any], kind: str, estimate: Callable[[Mapping, str], Pass], free: int
) -> list[str]:
    """One line for each key that lowers the memory, and one for all of them together."""
    lines, together = [], copy.deepcopy(dict(config))
    for key, change in _changes(config, estimate is trained).items():
        alone = copy.deepcopy(dict(config))
        change(alone)
        change(together)
        lines.append(_line(key, estimate(alone, kind), free))
    return [*lines, _line("all of them", estimate(together, kind), free)] if lines else lines


def _line(key: str, found: Pass, free: int) -> str:
    return f"  {key}: {decimal(found.bytes)}, {'fits' if found.bytes < free else 'does not fit'}"


def _changes(config: Mapping[str, Any], training: bool) -> dict[str, Change]:
    """Keys that the configuration does not use yet."""
    encoder = config["encoder"]
    found: dict[str, Change] = {}
    if config["skip"]["tokens"] == "all" and not config["skip"].get("choices"):
        found["skip=fast"] = lambda c: c["skip"].update(tokens="subject")
    if not training:
        return found
    if not encoder["checkpointing"] and encoder["trainable"] != "none":
        found["encoder.checkpointing=true"] = lambda c: c["encoder"].update(checkpointing=True)
    if str(config["trainer"]["precision"]) not in _PRECISIONS:
        found["trainer.precision=bf16-mixed"] = lambda c: c["trainer"].update(precision="bf16-mixed")
    size = config["data"]["batch_size"]
    if size > 1:
        key = f"data.batch_size=1 trainer.accumulate_grad_batches={size}"
        found[key] = lambda c: c["data"].update(batch_size=1)
    if encoder["trainable"] != "none":
        found["encoder.trainable=none"] = lambda c: c["encoder"].update(trainable="none")
    return found
