"""A single HTML file that shows Gaussians in any browser with WebGL 2, without network access."""

import base64
import html
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from importlib.resources import files

import numpy as np
import torch
from torch import Tensor

from ghgs_capture.export.subject import ExportedSubject
from ghgs_lit.ply import stored_values
from ghgs_lit.types import Gaussians

#: Quantisation steps per pixel of a photograph (centre), per factor of e (standard deviation) and per
#: unit (opacity, rotation): ``FINE`` for one instant, ``COARSE`` for each of several.
FINE = {"center": 64, "scale": 24, "opacity": 255, "rotation": 127}
COARSE = {"center": 12, "scale": 12, "opacity": 127, "rotation": 31}
#: Numbers of each Gaussian that are stored in four bytes (its centre) and in one byte (the others)
_WIDE = 3
_NARROW = 10
_LARGEST = 1 << 29


def pack(gaussians: Gaussians, pixel: float, center: Tensor, steps: Mapping[str, int]) -> bytes:
    """Quantise and compress Gaussians to byte planes [22, N], which ``page.html`` unpacks.

    Each Gaussian is converted to integers: its centre relative to ``center`` in fractions of ``pixel``;
    the logarithms of its standard deviations; colour and opacity; and its rotation as ``v / (1 + w)`` of
    the unit quaternion ``(w, v)`` with ``w >= 0``. Each number is stored as the difference from the
    previous Gaussian, which is usually a neighbour.

    Args:
        gaussians: Gaussians of one subject, with RGB colours.
        pixel: side of a photograph's pixel at the subject, in the unit of the cameras.
        center: point [3] in the middle of the subject.
        steps: ``FINE`` or ``COARSE``.

    Returns:
        The planes, compressed by zlib.
    """
    values = stored_values(gaussians, torch.float64)
    w, v = values["quaternions"].split((1, 3), dim=1)
    parts = (
        ((values["means"] - center.cpu()) * (steps["center"] / pixel)).clamp(-_LARGEST, _LARGEST),
        ((values["scales"] / pixel).log() * steps["scale"]).clamp(-128, 127),
        values["colors"].clamp(0, 1) * 255,
        values["opacities"].clamp(0, 1)[:, None] * steps["opacity"],
        v * torch.where(w < 0, -1, 1) / (1 + w.abs()) * steps["rotation"],
    )
    numbers = torch.cat([part.round().long() for part in parts], dim=1).numpy()
    numbers[:, [6, 8]] -= numbers[:, [7]]  # red and blue are similar to green
    wide, narrow = np.split(np.diff(numbers, axis=0, prepend=0), [_WIDE], axis=1)
    # with the sign as the last bit, high bytes are mostly 0
    wide = ((wide << 1) ^ (wide >> 63)).astype("<u4")
    planes = wide.view(np.uint8).T.tobytes() + narrow.astype(np.uint8).T.tobytes()
    packer = zlib.compressobj(9, strategy=zlib.Z_FILTERED)
    return packer.compress(planes) + packer.flush()


def page(
    subject: ExportedSubject,
    name: str,
    packed: Sequence[bytes] = (),
    path: Sequence[Sequence[float]] = ((0.0, 0.0, 0.0),),
    fps: float = 1.0,
) -> str:
    """Create a page that shows one instant or plays several, with a button for each camera.

    Args:
        subject: the first instant; the page starts at its first camera.
        name: title of the page, as plain text.
        packed: :func:`pack` of each of several instants, with ``COARSE``; empty: only the subject.
        path: translation [instants, 3] of the page's camera at each instant.
        fps: instants per second.

    Returns:
        The content of the HTML file.
    """
    gaussians = subject.gaussians
    cameras = subject.cameras
    center = subject.center
    pixel = subject.pixel
    steps = COARSE if packed else FINE
    packed = packed or [pack(gaussians, pixel, center, steps)]
    scene = {
        "size": [cameras.width, cameras.height],
        "up": subject.up.tolist(),
        "target": center.tolist(),
        "pixel": pixel,
        "steps": steps,
        "low_pass": gaussians.low_pass,
        "antialiased": gaussians.antialiased,
        "cameras": [
            {"name": view, "intrinsics": k.tolist(), "extrinsics": e.tolist()}
            for view, k, e in zip(subject.views, cameras.intrinsics, cameras.extrinsics, strict=True)
        ],
        "path": path,
        "fps": fps,
    }
    text = files("ghgs_capture.export").joinpath("page.html").read_text()
    values = {
        "title": html.escape(name),
        # "<!--", "<script" and "</" have a meaning inside a script, too.
        "scene": json.dumps(scene).replace("<", "\\u003c"),
        "data": "\n".join(base64.b64encode(instant).decode() for instant in packed),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda name: values[name[1]], text)
