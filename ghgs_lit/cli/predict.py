"""``ghgs predict``: one subject's photographs to a splat (PLY) and pictures from all around."""

import dataclasses

import torch
from lightning.pytorch import LightningDataModule
from omegaconf import DictConfig

from ghgs_lit.cli.inputs import build_data, check_size, pick_device, with_trained_data
from ghgs_lit.cli.runtime import announce, output_dir, save_config
from ghgs_lit.config import build
from ghgs_lit.errors import InputError, require
from ghgs_lit.export.ply import write_ply
from ghgs_lit.model import GHGS
from ghgs_lit.types import Batch
from ghgs_lit.visualization.pictures import save_png, sheet, to_uint8
from ghgs_lit.visualization.turntable import turntable


def subject_batch(data: LightningDataModule, subject: str | int, split: str) -> Batch:
    """The evaluation sample of a subject, given by name or by its number in the split."""
    loader = data.evaluation_loader(split=split, batch_size=1)
    names = list(data.subjects(split))
    if isinstance(subject, int) and 0 <= subject < len(names):
        subject = names[subject]
    if subject not in names:
        raise InputError(
            f"subject: expected 0 to {len(names) - 1} or a name such as {names[0]}; found {subject!r}"
        )
    return next(batch for batch in loader if subject in batch.subjects)


@torch.no_grad()
def run(cfg: DictConfig) -> None:
    """The verb; prints the path of the splat last."""
    directory = output_dir()
    config = save_config(with_trained_data(cfg), directory)
    frames = config["turntable"]["frames"]
    require(isinstance(frames, int) and frames >= 0, "turntable.frames", "a number of at least 0", frames)
    device = pick_device(config["device"])
    model = GHGS.from_checkpoint(config["checkpoint"]).to(device).eval()
    model.precision = config["precision"]
    renderer = build(config["renderer"], "renderer")
    data = build_data(config)
    check_size(data, model)
    data.prepare_data()
    batch = subject_batch(data, config["subject"], config["split"]).to(device)
    name = batch.subjects[0]
    prediction = model(dataclasses.replace(batch, targets=None))
    image = renderer(prediction.gaussians, batch.targets.cameras).image
    save_png(sheet(batch, image, 0, prediction.depth, prediction.depth_valid), directory / f"{name}.png")
    orbit = turntable(batch.cameras[0], frames)
    for frame in range(frames):
        camera = orbit[frame : frame + 1][None]
        picture = to_uint8(renderer(prediction.gaussians, camera).image[0, 0])
        save_png(picture, directory / "turntable" / f"{frame:03d}.png")
    path = directory / f"{name}.ply"
    write_ply(prediction.gaussians, path)
    announce(path)
