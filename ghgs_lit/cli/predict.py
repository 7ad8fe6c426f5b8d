"""``ghgs predict``: one subject's photographs to a splat, and to what else ``formats`` lists."""

import dataclasses
import time
from typing import Any

import torch
from omegaconf import DictConfig

from ghgs_lit.cli.inputs import (
    build_data,
    build_renderer,
    check_size,
    model_of,
    pick_device,
    with_trained_data,
)
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.config import resolve
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.errors import InputError
from ghgs_lit.export import output_options, write_prediction
from ghgs_lit.model import GHGS, STAGES
from ghgs_lit.types import Batch


def subject_batch(
    data: PhotographsDataModule, subject: str | int, split: str, targets: dict[str, Any] | None
) -> Batch:
    """The photographs of one subject.

    Args:
        data: the photographs of all subjects.
        subject: its name, or its number in the split.
        split: whose subjects are numbered.
        targets: a protocol whose targets are read too; None: inputs only.

    Raises:
        InputError: there is no such subject.
    """
    names = list(data.subjects(split))
    if isinstance(subject, int) and 0 <= subject < len(names):
        subject = names[subject]
    if subject not in names:
        raise InputError(
            f"subject: expected 0 to {len(names) - 1} or a name such as {names[0]}; found {subject!r}"
        )
    return data.evaluation_batch(subject, split, targets=targets)


@torch.no_grad()
def run(cfg: DictConfig) -> None:
    """The verb; prints the files (not those in folders), and the directory last."""
    directory = output_dir()
    config = resolve(with_trained_data(cfg)) | model_of(cfg.checkpoint, cfg)
    write_config(config, directory)
    options = output_options(config)
    device = pick_device(config["device"])
    renderer = build_renderer(config, device)
    model = GHGS.from_config(config, empty=STAGES)
    model.load(config["checkpoint"])
    model.precision = config["precision"]
    model.to(device).eval()
    data = build_data(config)
    check_size(data, model)
    data.prepare_data()
    batch = subject_batch(data, config["subject"], config["split"], config.get("targets")).to(device)
    begin = time.perf_counter()
    prediction = model(dataclasses.replace(batch, targets=None))
    if device.type == "cuda":
        torch.cuda.synchronize()
    facts = {"checkpoint": config["checkpoint"], "seconds": {"predict": time.perf_counter() - begin}}
    paths = write_prediction(directory, batch, prediction, renderer, options, facts)
    print("\n".join(str(path) for path in paths if path.parent == directory), flush=True)
    announce(directory)
