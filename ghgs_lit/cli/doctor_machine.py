"""``ghgs doctor task=machine``: what there is, what is missing, and what the configuration needs."""

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
from ghgs_lit.diagnostics.doctor.estimate import BACKWARD, LOSS, Pass, Scene, estimate, parameters
from ghgs_lit.diagnostics.doctor.machine import machine_lines, memory_of_host, missing_extras
from ghgs_lit.model import STAGES

#: Of the products, by ``trainer.precision``.
_PRECISIONS = {"bf16-mixed": "bfloat16", "16-mixed": "float16"}


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
    free = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else memory_of_host()[1]
    free = free if config["gpu_memory"] is None else int(1e9 * config["gpu_memory"])
    for line in advice(config, kind, prediction, step, free):
        console.print(line, markup=False)


def predicted(config: Mapping[str, Any], kind: str) -> Pass:
    """A prediction of one subject in float32."""
    return estimate(config, _scene(config), kind, "float32")


def trained(config: Mapping[str, Any], kind: str) -> Pass:
    """A step of training with the batch and the precision of the configuration."""
    scene = dataclasses.replace(
        _scene(config),
        views=max(config["views"]["training_counts"]),
        batch=config["data"]["batch_size"],
        targets=config["targets"]["per_step"],
    )
    precision = _PRECISIONS.get(str(config["trainer"]["precision"]), "float32")
    return estimate(config, scene, kind, precision, training=True)


def _scene(config: Mapping[str, Any]) -> Scene:
    size = image_size("data.size", config["data"]["size"])
    return Scene(config["share"], config["views"]["evaluation_count"], size)


def _table(config: Mapping[str, Any], prediction: Pass, step: Pass) -> Table:
    """Parameters, products and memory by stage."""
    table = Table("stage", box=None)
    for name in ("parameters", "trained", "prediction: GFLOP", "memory", "training step: GFLOP", "memory"):
        table.add_column(name, justify="right")
    sizes = parameters(config)
    sizes[TOTAL] = sizes["model"]
    for name in (*STAGES, RENDER, LOSS, BACKWARD, TOTAL):
        cells = [f"{number:,}" for number in sizes[name]] if name in sizes else ["", ""]
        for need in (prediction, step):
            known = name in need.peaks
            cells.append(f"{need.flops[name] / 1e9:,.1f}" if known else "")
            cells.append(decimal(need.held + need.peaks[name]) if known else "")
        table.add_row(name, *cells)
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
    config: Mapping[str, Any], kind: str, again: Callable[[Mapping, str], Pass], free: int
) -> list[str]:
    """One line for each key that lowers the memory, and one for all of them together."""
    savings = _savings(config, again is trained)
    if savings:
        savings["all of them"] = {k: v for values in savings.values() for k, v in values.items()}
    lines = []
    for key, values in savings.items():
        need = again(_changed(config, values), kind).bytes
        lines.append(f"  {key}: {decimal(need)}, {'fits' if need < free else 'does not fit'}")
    return lines


def _changed(config: Mapping[str, Any], values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The configuration with other values of ``<node>.<name>``."""
    for key, value in values.items():
        node, name = key.split(".")
        config = {**config, node: {**config[node], name: value}}
    return config


def _savings(config: Mapping[str, Any], training: bool) -> dict[str, dict[str, Any]]:
    """What lowers the memory and is not used yet, as it is said on the command line, and what it sets."""
    encoder, size = config["encoder"], config["data"]["batch_size"]
    learns = training and encoder["trainable"] != "none"
    precise = training and str(config["trainer"]["precision"]) not in _PRECISIONS
    whole = config["skip"]["tokens"] == "all" and not config["skip"].get("choices")
    savings = {
        "skip=fast": (whole, {"skip.tokens": "subject"}),
        "encoder.checkpointing=true": (
            learns and not encoder["checkpointing"], {"encoder.checkpointing": True},
        ),
        "trainer.precision=bf16-mixed": (precise, {"trainer.precision": "bf16-mixed"}),
        f"data.batch_size=1 trainer.accumulate_grad_batches={size}": (
            training and size > 1, {"data.batch_size": 1},
        ),
        "encoder.trainable=none": (learns, {"encoder.trainable": "none"}),
    }  # fmt: skip
    return {key: values for key, (helps, values) in savings.items() if helps}
