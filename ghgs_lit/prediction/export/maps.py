"""Contents of files in common formats: depth maps, photographs, videos and cameras."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from PIL import Image

from ghgs_lit.geometry.masks import unmultiplied
from ghgs_lit.prediction.export.subject import ExportedSubject
from ghgs_lit.visualization.pictures import to_uint8


def png(picture: np.ndarray) -> bytes:
    """A picture as PNG: [h, w, 3] or with alpha [h, w, 4] uint8."""
    content = BytesIO()
    Image.fromarray(picture).save(content, format="PNG")
    return content.getvalue()


# Without these, a player guesses matrix and range, and may show other colours.
_COLORS = (
    "-vf scale=out_color_matrix=bt709:out_range=tv -colorspace bt709 -color_primaries bt709 -color_trc bt709"
)


def mp4_bytes(pictures: Sequence[np.ndarray], fps: int) -> bytes:
    """The content of a video of pictures [h, w, 3] uint8; odd sides get another row or column."""
    import imageio_ffmpeg

    height, width = pictures[0].shape[:2]
    padding = ((0, height % 2), (0, width % 2), (0, 0))
    with TemporaryDirectory() as folder:
        path = Path(folder, "video.mp4")
        writer = imageio_ffmpeg.write_frames(
            str(path),
            (width + width % 2, height + height % 2),
            fps=fps,
            quality=8,
            macro_block_size=2,
            output_params=[*_COLORS.split(), "-movflags", "+faststart"],
        )
        writer.send(None)
        for picture in pictures:
            writer.send(np.ascontiguousarray(np.pad(picture, padding, mode="edge")))
        writer.close()
        return path.read_bytes()


def depth_npz(subject: ExportedSubject) -> bytes:
    """An NPZ with ``depth`` [V, H, W] (nan: none), ``intrinsics``, ``extrinsics`` and ``views``."""
    valid = subject.depth_valid.cpu().numpy()
    depth = np.where(valid, subject.depth.float().cpu().numpy(), np.float32(np.nan))
    cameras = {name: getattr(subject.cameras, name).cpu().numpy() for name in ("intrinsics", "extrinsics")}
    content = BytesIO()
    np.savez_compressed(content, depth=depth, **cameras, views=np.array(subject.views))
    return content.getvalue()


def input_files(subject: ExportedSubject) -> Iterator[Callable[[], bytes]]:
    """Functions that make a PNG of each view as the model saw it, with matte or mask as alpha, then the
    cameras: what ``ghgs predict images=inputs cameras=cameras.json`` reads."""
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
    """A camera of this package's JSON. ``size``: (height, width) of its photograph in pixels."""
    matrices = {"intrinsics": intrinsics.tolist(), "extrinsics": extrinsics.tolist()}
    return {**matrices, "width": size[1], "height": size[0]}


def cameras_json(entries: Mapping[str, dict[str, Any]]) -> str:
    """The text of this package's JSON of cameras, from :func:`camera_entry` by name."""
    return json.dumps({"cameras": entries}, indent=1)
