"""``ghgs predict``: photographs to a splat, and to what else ``formats`` lists."""

import dataclasses
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
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
from ghgs_lit.cli.photographs import capture_folder, fixed_camera, require_consistent
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.config import resolve
from ghgs_lit.config.settings import image_size
from ghgs_lit.errors import InputError, require
from ghgs_lit.model import GHGS, STAGES
from ghgs_lit.prediction.capture.doctor import diagnose
from ghgs_lit.prediction.capture.predict import predict, trained_size
from ghgs_lit.prediction.export import output_options, write_prediction
from ghgs_lit.prediction.export.video import write_mp4
from ghgs_lit.prediction.refinement import CameraRefinement, Refinement, pixels_moved
from ghgs_lit.rendering import Renderer
from ghgs_lit.surroundings import side_multiple
from ghgs_lit.types import Batch, Prediction
from ghgs_lit.visualization.pictures import to_uint8
from ghgs_lit.weights.checkpoint import read_checkpoint
from ghgs_lit.weights.loading import load_weights

if TYPE_CHECKING:  # it would import Lightning, which takes seconds
    from ghgs_lit.data.datamodule import PhotographsDataModule


def subject_batch(
    data: "PhotographsDataModule", subject: str | int, split: str, targets: dict[str, Any] | None
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
    directory = output_dir() if cfg.out is None else Path(cfg.out).expanduser().resolve()
    own = cfg.images is not None or cfg.cameras is not None
    config = resolve(cfg if own else with_trained_data(cfg)) | model_of(cfg.checkpoint, cfg)
    write_config(config, directory)
    (predict_photographs if own else predict_subject)(config, directory)
    announce(directory)


def predict_subject(config: dict[str, Any], directory: Path) -> None:
    """Predict a subject of a data set."""
    expected = "0 without images=...: photographs of data sets are on black"
    require(config["refine_masks"] == 0, "refine_masks", expected, config["refine_masks"])
    options, (model, renderer, device) = output_options(config), load(config)
    data = build_data(config)
    check_size(data, model)
    data.prepare_data([config["split"]])
    batch = subject_batch(data, config["subject"], config["split"], config.get("targets")).to(device)
    facts, seconds, begin = {"checkpoint": config["checkpoint"]}, {}, time.perf_counter()
    if config["refine_cameras"]:
        taken, batch = batch, CameraRefinement(config["refine_cameras"], model, renderer)(batch)
        facts |= cameras_moved(pixels_moved(taken, batch)[0])
        seconds["refine_cameras"] = time.perf_counter() - begin
        begin = time.perf_counter()
    prediction = model(dataclasses.replace(batch, targets=None))
    if device.type == "cuda":
        torch.cuda.synchronize()
    seconds["predict"] = time.perf_counter() - begin
    facts["seconds"] = seconds
    facts |= chosen_preset(model, prediction)
    prediction = refined(prediction, batch, renderer, config["refine"], facts)
    write(directory, batch, prediction, renderer, options, facts)


def predict_photographs(config: dict[str, Any], directory: Path) -> None:
    """Predict each instant of a folder of photographs; several get a folder each, and one video."""
    folder, options = capture_folder(config), output_options(config)
    if config["check_cameras"]:
        diagnosis = diagnose(folder)
        require_consistent(diagnosis)
        print("\n".join(diagnosis.lines), flush=True)
    size = image_size("size", config["size"] or trained_size(read_checkpoint(config["checkpoint"])["config"]))
    model, renderer, device = load(config)
    multiple = side_multiple(model.options, model.encoder.patch_size)
    expected = f"sides divisible by the patch size {multiple}"
    require(not any(side % multiple for side in size), "size", expected, size)
    totals: dict[str, float] = {}
    several = len(folder.instants) > 1
    pictures: list[np.ndarray] = []
    begin = time.perf_counter()
    # The next photographs are decoded while the model works.
    with ThreadPoolExecutor(1) as pool:
        captures = deque(pool.submit(folder.read, name) for name in folder.instants[:1])
        for number, name in enumerate(folder.instants, 1):
            start = time.perf_counter()
            capture = captures.popleft().result()
            waited = time.perf_counter() - start
            if number < len(folder.instants):
                captures.append(pool.submit(folder.read, folder.instants[number]))
            result = predict(capture, model, size, config["refine_cameras"], config["refine_masks"])
            facts = {
                "checkpoint": config["checkpoint"],
                "seconds": {"read": waited, **result.seconds},
                **chosen_preset(model, result.prediction),
            }
            if result.changed:
                facts |= masks_changed(result.changed)
            if result.moved:
                facts |= cameras_moved(result.moved)
            prediction = refined(result.prediction, result.batch, renderer, config["refine"], facts)
            start = time.perf_counter()
            place = directory / name if several else directory
            write(place, result.batch, prediction, renderer, options, facts)
            if several and "mp4" in options.formats:
                if number == 1:
                    camera = fixed_camera(capture).to(device)
                pictures.append(to_uint8(renderer(prediction.gaussians, camera).image[0, 0]))
            for stage, value in (facts["seconds"] | {"write": time.perf_counter() - start}).items():
                totals[stage] = totals.get(stage, 0.0) + value
    if pictures:
        write_mp4(pictures, directory / "instants.mp4", options.fps)
    if several:
        count, total = len(folder.instants), time.perf_counter() - begin
        stages = ", ".join(f"{stage} {value / count:.3g} s" for stage, value in totals.items())
        print(f"{count} instants, {count / total:.3g} a second (each: {stages})", flush=True)


def load(config: dict[str, Any]) -> tuple[GHGS, Renderer, torch.device]:
    """The model of a checkpoint and the renderer, on the device of a configuration."""
    device = pick_device(config["device"])
    renderer = build_renderer(config, device)
    model = GHGS.from_config(config, empty=STAGES)
    load_weights(model, config["checkpoint"], device=device)
    model.precision = config["precision"]
    return model.to(device).eval(), renderer, device


def cameras_moved(pixels: Sequence[float]) -> dict[str, Any]:
    """For the report, and printed: how far correcting the cameras moved the subject in each photograph."""
    print(f"refine_cameras: moved by {', '.join(f'{value:.2f}' for value in pixels)} pixels", flush=True)
    return {"refine_cameras": list(pixels)}


def masks_changed(shares: Sequence[float]) -> dict[str, Any]:
    """For the report, and printed: which share of the subject refining changed in each photograph."""
    print(
        f"refine_masks: changed by {', '.join(f'{share:.1%}' for share in shares)} of the subject", flush=True
    )
    return {"refine_masks": list(shares)}


def refined(
    prediction: Prediction, batch: Batch, renderer: Renderer, steps: int, facts: dict[str, Any]
) -> Prediction:
    """The prediction after ``steps`` of optimisation; notes and prints what they gained."""
    if steps == 0:
        return prediction
    begin, refinement = time.perf_counter(), Refinement(steps, renderer)
    gaussians = refinement(prediction.gaussians, batch)
    facts["seconds"] = {**facts["seconds"], "refine": time.perf_counter() - begin}
    report = refinement.report(prediction.gaussians, gaussians, batch)
    facts["refine"] = dataclasses.asdict(report)
    print(report, flush=True)
    return dataclasses.replace(prediction, gaussians=gaussians)


def chosen_preset(model: GHGS, prediction: Prediction) -> dict[str, str]:
    """For the report: which preset ``skip=auto`` chose and why, which is printed too; nothing without it."""
    if model.auto is None:
        return {}
    line = model.auto.report(prediction.decisions)
    print(line, flush=True)
    return {"skip": line}


def write(directory: Path, *prediction: Any) -> None:
    """Write a prediction (arguments of :func:`write_prediction`); print the files that are in no folder."""
    paths = write_prediction(directory, *prediction)
    print("\n".join(str(path) for path in paths if path.parent == directory), flush=True)
