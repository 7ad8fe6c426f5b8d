"""Everything that is written of a prediction: one entry of ``WRITERS`` for each format."""

import json
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ghgs_lit.files import write_atomically, write_text_atomically
from ghgs_lit.geometry.frame import HEIGHT
from ghgs_lit.metrics import psnr
from ghgs_lit.metrics.functional import box_of
from ghgs_lit.prediction.export.compact import FORMATS, write_compact
from ghgs_lit.prediction.export.gltf import write_glb
from ghgs_lit.prediction.export.maps import depth_unit, write_depths, write_inputs, write_points
from ghgs_lit.prediction.export.page import write_page
from ghgs_lit.prediction.export.ply import ply_bytes, write_ply
from ghgs_lit.prediction.export.scene import OutputOptions, Scene, options_of, scene_of
from ghgs_lit.prediction.export.splat import to_records
from ghgs_lit.prediction.export.video import write_mp4
from ghgs_lit.rendering import Renderer
from ghgs_lit.runs.provenance import versions
from ghgs_lit.runs.results import plain
from ghgs_lit.types import Batch, Prediction
from ghgs_lit.visualization.pictures import save_png, sheet


def _ply(scene: Scene, directory: Path) -> list[Path]:
    path = directory / "gaussians.ply"
    write_ply(scene.stored, path)
    return [path]


def _compact(scene: Scene, directory: Path, name: str) -> list[Path]:
    path = directory / f"gaussians.{FORMATS[name]}"
    write_compact(ply_bytes(scene.stored), path, name)
    return [path]


def _splat(scene: Scene, directory: Path) -> list[Path]:
    path = directory / "gaussians.splat"
    data = to_records(scene.stored).tobytes()
    write_atomically(path, lambda temporary: temporary.write_bytes(data))
    return [path]


def _glb(scene: Scene, directory: Path) -> list[Path]:
    path = directory / "gaussians.glb"
    write_glb(scene.stored, scene.up, path)
    return [path]


def _html(scene: Scene, directory: Path) -> list[Path]:
    path = directory / "viewer.html"
    write_page(scene.gaussians, scene.cameras, scene.views, scene.up, scene.name, path)
    return [path]


def _turntable(scene: Scene, directory: Path) -> list[Path]:
    """Pictures from all around, ``turntable/000.png`` and so on."""
    paths = [directory / "turntable" / f"{frame:03d}.png" for frame in range(scene.options.frames)]
    for picture, path in zip(scene.turntable, paths, strict=True):
        save_png(picture, path)
    return paths


def _mp4(scene: Scene, directory: Path) -> list[Path]:
    path = directory / "turntable.mp4"
    write_mp4(scene.turntable, path, scene.options.fps)
    return [path]


WRITERS: dict[str, Callable[[Scene, Path], list[Path]]] = {
    "ply": _ply,
    **{name: partial(_compact, name=name) for name in FORMATS},
    "splat": _splat,
    "glb": _glb,
    "html": _html,
    "turntable": _turntable,
    "mp4": _mp4,
    "depth": write_depths,
    "points": write_points,
    "inputs": write_inputs,
}
"""The writer of each format: writes into a directory and returns the paths."""


def output_options(config: Mapping[str, Any]) -> OutputOptions:
    """The options of a verb's configuration, checked before any work (:func:`options_of`)."""
    return options_of(config, tuple(WRITERS))


@torch.no_grad()
def write_prediction(
    directory: Path,
    batch: Batch,
    prediction: Prediction,
    renderer: Renderer,
    options: OutputOptions,
    facts: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write the prediction of one subject, ``sheet.png`` to look at and ``report.json`` about it.

    Lengths in the files are in the unit of the batch's cameras.

    Args:
        directory: files of these names are replaced, others stay.
        batch: photographs, masks and cameras of the subject; the sheet compares renders with targets, too.
        prediction: of this batch.
        renderer: draws the turntable, and the input views for the report.
        options: the formats and the frame.
        facts: further plain data for the report, such as the seconds of each stage.

    Returns:
        What was written, ``report.json`` last.

    Raises:
        InputError: several subjects.
    """
    scene = scene_of(batch, prediction, renderer, options)
    paths, seconds = [], {}
    for name in options.formats:
        begin = time.perf_counter()
        paths += WRITERS[name](scene, directory)
        seconds[f"write {name}"] = time.perf_counter() - begin
    image = None if batch.targets is None else renderer(prediction.gaussians, batch.targets.cameras).image
    paths.append(directory / "sheet.png")
    save_png(sheet(batch, image, 0, prediction.depth, prediction.depth_valid), paths[-1])
    facts = dict(facts or {})
    report = {**_report(scene), **facts, "seconds": {**facts.get("seconds", {}), **seconds}}
    report["files"] = {str(path.relative_to(directory)): path.stat().st_size for path in paths}
    path = directory / "report.json"
    write_text_atomically(path, json.dumps(plain(report), indent=1, allow_nan=False))
    return [*paths, path]


def _report(scene: Scene) -> dict[str, Any]:
    """Counts and checks of a scene; PSNR in dB in the box of the subject says how the inputs are met."""
    gaussians, valid = scene.gaussians, scene.depth_valid
    lost = scene.masks & ~valid
    image = scene.renderer(gaussians, scene.cameras[None]).image[0].clamp(0, 1)
    quality = psnr(image, scene.images, box_of(scene.masks)).tolist()
    means = gaussians.means if len(gaussians) else gaussians.means.new_full((1, 3), torch.nan)
    return {
        "subject": scene.name,
        "views": list(scene.views),
        "gaussians": len(gaussians),
        "gaussians_not_finite": scene.dropped,
        "frame": "world of the cameras" if scene.options.up is None else f"up is +{scene.options.up}",
        "up": scene.up.tolist(),
        "subject_size": None if gaussians.metre is None else HEIGHT * float(gaussians.metre[0]),
        "smallest": means.amin(0).tolist(),
        "largest": means.amax(0).tolist(),
        "depths_not_finite": dict(zip(scene.views, lost.flatten(1).sum(1).tolist(), strict=True)),
        "depth_pixels": dict(zip(scene.views, valid.flatten(1).sum(1).tolist(), strict=True)),
        "depth_png_unit": depth_unit(float(torch.where(valid, scene.depth, 0).max())),
        "psnr_box_of_inputs": dict(zip(scene.views, quality, strict=True)),
        "versions": versions(),
    }
