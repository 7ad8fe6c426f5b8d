"""Contents of files in common formats: pictures, depth maps, photographs and cameras."""

import json
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from io import BytesIO
from typing import Any

import numpy as np
import torch
from PIL import Image

from ghgs_capture.export.subject import ExportedSubject, file_names
from ghgs_lit.geometry.masks import unmultiplied
from ghgs_lit.visualization.pictures import to_uint8


def png(picture: np.ndarray) -> bytes:
    """Encode a picture as PNG.

    Args:
        picture: [h, w, 3], or with alpha [h, w, 4], uint8.

    Returns:
        The content of a file.
    """
    content = BytesIO()
    Image.fromarray(picture).save(content, format="PNG")
    return content.getvalue()


def depth_file(subject: ExportedSubject) -> bytes:
    """Depth maps as exact numbers.

    Args:
        subject: with depths of each view.

    Returns:
        The content of an NPZ with ``depth`` [V, H, W] float32 (nan: none), ``intrinsics``,
        ``extrinsics`` and ``views``.
    """
    depth = torch.where(subject.depth_valid, subject.depth.float(), torch.nan).cpu().numpy()
    cameras = {name: getattr(subject.cameras, name).cpu().numpy() for name in ("intrinsics", "extrinsics")}
    content = BytesIO()
    np.savez_compressed(content, depth=depth, **cameras, views=np.array(subject.views))
    return content.getvalue()


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
    entries = zip(file_names(subject.views), cameras.intrinsics, cameras.extrinsics, strict=True)
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
