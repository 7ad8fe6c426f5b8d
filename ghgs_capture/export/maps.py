"""Contents of files in common formats: depth maps, photographs, cameras and point clouds."""

import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from io import BytesIO
from typing import Any

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from ghgs_capture.export.subject import ExportedSubject
from ghgs_lit.geometry.masks import unmultiplied
from ghgs_lit.ply import vertices_ply
from ghgs_lit.visualization.pictures import to_uint8

_LEVELS = 65535  # of a picture of 16 bits


def png(picture: np.ndarray, text: PngInfo | None = None) -> bytes:
    """Encode a picture as PNG.

    Args:
        picture: [h, w] uint16, [h, w, 3] or with alpha [h, w, 4] uint8.
        text: entries of text in the file; None: none.

    Returns:
        The content of a file.
    """
    content = BytesIO()
    Image.fromarray(picture).save(content, format="PNG", pnginfo=text)
    return content.getvalue()


def depth_unit(largest: float) -> float:
    """Choose the length of one grey level of a depth picture.

    Args:
        largest: the largest depth, 0 or more.

    Returns:
        0.001, or another power of ten if ``largest`` needs it to fit into 16 bits and have at least
        1000 levels.
    """
    exponent = -3
    while largest > _LEVELS * 10.0**exponent:
        exponent += 1
    while 0 < largest < 1000 * 10.0**exponent:
        exponent -= 1
    return 10.0**exponent


def depth_files(subject: ExportedSubject) -> Iterator[Callable[[], bytes]]:
    """Depth maps as pictures and as exact numbers.

    Args:
        subject: with depths of each view.

    Yields:
        Functions that make a 16-bit PNG of each view (0: no depth; the unit stands in the file),
        then an NPZ with ``depth`` [V, H, W] float32 (nan: none), ``intrinsics``, ``extrinsics`` and
        ``views``.
    """
    valid = subject.depth_valid.cpu().numpy()
    depth = np.where(valid, subject.depth.float().cpu().numpy(), np.float32(np.nan))
    unit = depth_unit(float(np.max(depth, where=valid, initial=0)))
    text = PngInfo()
    text.add_text("Unit", f"{unit:g} (length of one grey level; 0: no depth)")
    for values in depth:
        yield partial(png, np.nan_to_num(np.round(values / unit)).astype(np.uint16), text)
    cameras = {name: getattr(subject.cameras, name).cpu().numpy() for name in ("intrinsics", "extrinsics")}

    def exact() -> bytes:
        content = BytesIO()
        np.savez_compressed(content, depth=depth, **cameras, views=np.array(subject.views))
        return content.getvalue()

    yield exact


def points_ply(subject: ExportedSubject) -> bytes:
    """Store the unprojected pixels of the subject with their colours.

    Args:
        subject: with its ``points``.

    Returns:
        The content of a PLY file.
    """
    positions = subject.points.float().cpu().numpy()
    colors = (subject.colors.float().clamp(0, 1) * 255).round().byte().cpu().numpy()
    columns = dict(zip("xyz", positions.T, strict=True))
    return vertices_ply(columns | dict(zip(("red", "green", "blue"), colors.T, strict=True)))


def input_files(subject: ExportedSubject) -> Iterator[Callable[[], bytes]]:
    """Photographs and cameras, as ``ghgs predict images=inputs cameras=cameras.json`` reads them.

    Args:
        subject: with its photographs.

    Yields:
        Functions that make a PNG of each view as the model saw it, with matte or mask as alpha,
        then the JSON of the cameras.
    """
    for image, matte in zip(subject.images, subject.mattes, strict=True):
        colors = to_uint8(unmultiplied(image, matte))  # PNG's colours are not premultiplied
        alpha = (matte * 255).round().byte().cpu().numpy()[..., None]
        yield partial(png, np.concatenate([colors, alpha], -1))
    cameras = subject.cameras
    entries = zip(subject.file_names, cameras.intrinsics, cameras.extrinsics, strict=True)
    size = (cameras.height, cameras.width)
    text = cameras_json({name: camera_entry(k, e, size) for name, k, e in entries})
    yield text.encode


def camera_entry(intrinsics: Any, extrinsics: Any, size: tuple[int, int]) -> dict[str, Any]:
    """A camera of this package's JSON.

    Args:
        intrinsics: array or tensor [3, 3] in pixels.
        extrinsics: array or tensor [4, 4], world to camera.
        size: (height, width) of its photograph in pixels.

    Returns:
        Plain data.
    """
    matrices = {"intrinsics": intrinsics.tolist(), "extrinsics": extrinsics.tolist()}
    return {**matrices, "width": size[1], "height": size[0]}


def cameras_json(entries: Mapping[str, dict[str, Any]]) -> str:
    """The text of this package's JSON of cameras.

    Args:
        entries: those of :func:`camera_entry`, by name.
    """
    return json.dumps({"cameras": entries}, indent=1)
