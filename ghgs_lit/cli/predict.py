"""``ghgs predict``: one subject's photographs to a splat (PLY) and pictures from all around."""

import dataclasses
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
from ghgs_lit.errors import InputError, require
from ghgs_lit.export.ply import write_ply
from ghgs_lit.model import GHGS, STAGES
from ghgs_lit.types import Batch
from ghgs_lit.visualization.pictures import save_png, sheet, to_uint8
from ghgs_lit.visualization.turntable import turntable


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
    """The verb; prints the path of the splat last."""
    directory = output_dir()
    config = resolve(with_trained_data(cfg)) | model_of(cfg.checkpoint, cfg)
    write_config(config, directory)
    frames = config["turntable"]["frames"]
    require(isinstance(frames, int) and frames >= 0, "turntable.frames", "a number of at least 0", frames)
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
    name, targets = batch.subjects[0], batch.targets
    prediction = model(dataclasses.replace(batch, targets=None))
    image = None if targets is None else renderer(prediction.gaussians, targets.cameras).image
    save_png(sheet(batch, image, 0, prediction.depth, prediction.depth_valid), directory / f"{name}.png")
    orbit = turntable(batch.cameras[0], frames)
    for frame in range(frames):
        camera = orbit[frame : frame + 1][None]
        picture = to_uint8(renderer(prediction.gaussians, camera).image[0, 0])
        save_png(picture, directory / "turntable" / f"{frame:03d}.png")
    path = directory / f"{name}.ply"
    write_ply(prediction.gaussians, path)
    announce(path)
