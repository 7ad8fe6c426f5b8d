"""Write the files of a prediction, with an entry of ``FORMATS`` for each format."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from PIL import Image

from ghgs_capture.export.instants import mp4_bytes
from ghgs_capture.export.page import page
from ghgs_capture.export.reports import begin_files, end_files, write_file
from ghgs_capture.export.subject import ExportedSubject, OutputOptions, export_subject, file_names
from ghgs_capture.formats.matrices import camera_entry, cameras_json
from ghgs_lit.errors import InputError, import_optional, require, require_choice
from ghgs_lit.geometry.frame import HEIGHT
from ghgs_lit.geometry.masks import unmultiply
from ghgs_lit.metrics import psnr
from ghgs_lit.metrics.regions import box_of
from ghgs_lit.ply import ply_bytes
from ghgs_lit.rendering import Renderer
from ghgs_lit.runs.results import versions
from ghgs_lit.runtime.cores import allowed_cores
from ghgs_lit.types import Batch, Gaussians, Prediction
from ghgs_lit.visualization.pictures import palette, sheet, to_uint8

if TYPE_CHECKING:
    from ghgs_capture.verbs import Predict

SHEET = "sheet.png"  #: Overview of inputs, renderings and depth
#: Formats that the package gaussforge converts a PLY to, with its name for each, also the file suffix
CONVERTED = {"compressed_ply": "compressed.ply", "spz": "spz", "sog": "sog"}


def half_turn(gaussians: Gaussians) -> Gaussians:
    """Rotate Gaussians by 180 degrees about x, between the axes of a PLY (right, down, front) and of SPZ
    (right, up, back).

    https://github.com/nianticlabs/spz, "Coordinate System"; gaussforge does not convert axes.

    Args:
        gaussians: Gaussians of any number of subjects, with view-independent colours.

    Returns:
        The Gaussians with y and z of means and quaternions negated.
    """
    means = gaussians.means * gaussians.means.new_tensor([1, -1, -1])
    quaternions = gaussians.quaternions * gaussians.quaternions.new_tensor([1, 1, -1, -1])
    return replace(gaussians, means=means, quaternions=quaternions)


def convert(name: str, gaussians: Gaussians) -> bytes:
    """Convert Gaussians to another program's format with the package gaussforge.

    Args:
        name: name of the format in ``CONVERTED``.
        gaussians: Gaussians of one subject, with RGB colours.

    Returns:
        The content of the file.

    Raises:
        InputError: gaussforge cannot convert them, for example if there are none.
    """
    from gaussforge import GaussForge  # here: optional dependency

    if name == "spz":
        gaussians = half_turn(gaussians)
    answer = GaussForge().convert(ply_bytes(gaussians), "ply", CONVERTED[name])
    if answer.get("error"):
        expected = "formats: expected Gaussians that gaussforge converts to"
        raise InputError(f"{expected} {name}; found {len(gaussians)}: {answer['error']}")
    return answer["data"]


def png(picture: np.ndarray) -> bytes:
    """Encode an image as PNG.

    Args:
        picture: [h, w, 3] or, with alpha, [h, w, 4], uint8.

    Returns:
        The content of the file.
    """
    content = BytesIO()
    Image.fromarray(picture).save(content, format="PNG")
    return content.getvalue()


def input_files(subject: ExportedSubject) -> Iterator[Callable[[], bytes]]:
    """Photographs and cameras, readable by ``ghgs predict images=inputs cameras=cameras.json``.

    Yields:
        Functions that encode each input view of the model as PNG, with matte or mask as alpha; last
        one that encodes the cameras as JSON.
    """
    for image, matte in zip(subject.images, subject.mattes, strict=True):
        colors = to_uint8(unmultiply(image, matte))  # colours in PNG are not premultiplied
        alpha = (matte * 255).round().byte().cpu().numpy()[..., None]
        yield partial(png, np.concatenate([colors, alpha], -1))
    cameras = subject.cameras
    entries = zip(file_names(subject.views), cameras.intrinsics, cameras.extrinsics, strict=True)
    size = (cameras.height, cameras.width)
    text = cameras_json({name: camera_entry(k, e, size) for name, k, e in entries})
    yield text.encode


@dataclass(frozen=True)
class Format:
    """A format. ``contents`` returns a function for each file, in order, which computes its content in a
    thread."""

    files: tuple[str, ...]  #: names; with ``{view}`` or ``{frame}`` one for each view or turntable image
    contents: Callable[[ExportedSubject], Iterable[Callable[[], bytes]]]
    package: str | None = None  #: optional package that the format needs
    extra: str = "formats"  #: extra of this distribution that installs the package

    def names(self, views: Sequence[str], frames: int) -> list[str]:
        """Names of all files.

        Args:
            views: names of the photographs.
            frames: number of images of the turntable.
        """
        names = []
        for pattern in self.files:
            if "{view}" in pattern:
                names += [pattern.format(view=name) for name in file_names(views)]
            elif "{frame" in pattern:
                names += [pattern.format(frame=frame) for frame in range(frames)]
            else:
                names.append(pattern)
        return names


def _one(content: Callable[[ExportedSubject], bytes]) -> Callable[[ExportedSubject], list]:
    return lambda subject: [partial(content, subject)]


def _of_viewers(content: Callable[[Gaussians], bytes]) -> Callable[[ExportedSubject], list]:
    """Contents of one file of the Gaussians for other viewers, which are fitted before threads start."""
    return lambda subject: [partial(content, subject.for_other_renderers)]


FORMATS: dict[str, Format] = {
    "ply": Format(("gaussians.ply",), _one(lambda s: ply_bytes(s.stored))),
    **{
        name: Format((f"gaussians.{suffix}",), _of_viewers(partial(convert, name)), "gaussforge")
        for name, suffix in CONVERTED.items()
    },
    "html": Format(("viewer.html",), _one(lambda s: page(s, s.name).encode())),
    "turntable": Format(("turntable/{frame:03d}.png",), lambda s: (partial(png, p) for p in s.turntable)),
    "mp4": Format(
        ("turntable.mp4",),
        lambda s: [partial(mp4_bytes, s.turntable, s.options.fps)],
        "imageio_ffmpeg",
        "video",
    ),
    "inputs": Format(("inputs/{view}.png", "cameras.json"), input_files),
}


def output_options(verb: "Predict") -> OutputOptions:
    """Read a verb's options for files, checked before any work.

    Raises:
        InputError: an unknown format, no frames for a video, or a package that is not installed.
    """
    formats = verb.formats
    formats = [formats] if isinstance(formats, str) else formats
    formats = tuple(FORMATS) if "all" in formats else tuple(dict.fromkeys(formats))
    for name in formats:
        require_choice("formats", name, ("all", *FORMATS))
        if FORMATS[name].package is not None:
            import_optional(FORMATS[name].package, FORMATS[name].extra, f"formats={name}")
    frames = verb.turntable.frames
    require(frames > 0 or "mp4" not in formats, "turntable.frames", "at least 1 for formats=mp4", frames)
    return OutputOptions(formats, verb.up, verb.smooth, frames, verb.turntable.fps)


def output_files(options: OutputOptions, views: Sequence[str]) -> list[str]:
    """Names of the files that :func:`write_prediction` writes, except the report.

    Args:
        options: formats and number of images of the turntable.
        views: names of the photographs.
    """
    names = []
    for format in options.formats:
        names += FORMATS[format].names(views, options.frames)
    return [*names, SHEET]


@torch.no_grad()
def write_prediction(
    directory: Path,
    batch: Batch,
    prediction: Prediction,
    renderer: Renderer,
    options: OutputOptions,
    facts: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Write the prediction of one subject, with an overview ``sheet.png`` and ``report.json``.

    Lengths in the files are in the unit of the batch's cameras.

    Args:
        directory: files of an earlier prediction are replaced, others remain.
        batch: photographs, masks and cameras of the subject; the overview compares renderings with its
            targets, or with the photographs if it has none.
        prediction: prediction for this batch, in the world of its cameras.
        renderer: renders the turntable, and the input views for the report.
        options: formats and their options.
        facts: further plain data for the report.

    Returns:
        The paths of the files, ``report.json`` last.

    Raises:
        InputError: there are several subjects, or a file that no prediction wrote would be replaced.
    """
    subject = export_subject(batch, prediction, renderer, options)
    names = output_files(options, subject.views)
    begin_files(directory, names)
    with ThreadPoolExecutor(allowed_cores()) as pool:
        pool.submit(palette, "turbo")  # imports matplotlib for the overview in the background
        tasks = []
        for name in options.formats:
            files = FORMATS[name].names(subject.views, options.frames)
            for file, made in zip(files, FORMATS[name].contents(subject), strict=True):
                tasks.append(pool.submit(write_file, directory / file, made))
        seen = batch.cameras if batch.targets is None else batch.targets.cameras
        image = renderer(prediction.gaussians, seen).image
        overview = sheet(batch, image, 0, prediction.depth, prediction.depth_valid)
        write_file(directory / SHEET, partial(png, overview))
        report = {**_report(subject), **(facts or {})}
        for task in tasks:
            task.result()
    return end_files(directory, names, report)


def _report(subject: ExportedSubject) -> dict[str, Any]:
    """Plain data about a prediction: counts, lengths in the unit of the cameras, PSNR of input views."""
    gaussians = subject.gaussians
    drawn = subject.renderer(gaussians, subject.cameras[None])
    image = drawn.image[0].clamp(0, 1)
    quality = psnr(image, subject.images, box_of(subject.masks)).tolist()
    means = gaussians.means if len(gaussians) else gaussians.means.new_full((1, 3), torch.nan)
    return {
        "subject": subject.name,
        "views": list(subject.views),
        "gaussians": len(gaussians),
        "gaussians_not_finite": subject.dropped,
        "frame": "world of the cameras" if subject.options.up is None else f"up is +{subject.options.up}",
        "up": subject.up.tolist(),
        "subject_size": None if gaussians.metre is None else HEIGHT * float(gaussians.metre[0]),
        "smallest": means.amin(0).tolist(),
        "largest": means.amax(0).tolist(),
        "psnr_box_of_inputs": dict(zip(subject.views, quality, strict=True)),
        "versions": versions(),
    }
