"""A single HTML file that shows Gaussians in any browser with WebGL 2, without a network."""

import base64
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib.resources import files

from torch import Tensor

from ghgs_lit.prediction.export.packed import FINE, pack
from ghgs_lit.types import Cameras, Gaussians
from ghgs_lit.visualization.turntable import pixel_size


def page(
    gaussians: Gaussians, cameras: Cameras, views: Sequence[str], up: Tensor, center: Tensor, name: str
) -> str:
    """The text of the page of one instant, which begins at the first camera, and has a button for each.

    Args:
        gaussians: of one subject, RGB colours.
        cameras: of the photographs [V].
        up: the unit vector [3] that points up.
        center: the point [3] that it turns about.
    """
    packed = [pack(gaussians, pixel_size(cameras, center), center, FINE)]
    return page_of(packed, FINE, gaussians, cameras, views, up, center, name)


def page_of(
    packed: Sequence[bytes],
    steps: Mapping[str, int],
    gaussians: Gaussians,
    cameras: Cameras,
    views: Sequence[str],
    up: Tensor,
    center: Tensor,
    name: str,
    path: Sequence[Sequence[float]] = ((0.0, 0.0, 0.0),),
    fps: float = 1.0,
) -> str:
    """The text of the page that plays several instants.

    Args:
        packed: of each instant what :func:`pack` gives with ``steps`` and the size of pixels at ``center``.
        gaussians, cameras, views, up, center: of the first instant, as of :func:`page`.
        path: how far from the first instant the viewer's camera moves along with the subject [instants, 3].
        fps: instants a second.
    """
    scene = {
        "size": [cameras.width, cameras.height],
        "up": up.tolist(),
        "target": center.tolist(),
        "pixel": pixel_size(cameras, center),
        "steps": dict(steps),
        "low_pass": gaussians.low_pass,
        "antialiased": gaussians.antialiased,
        "cameras": [
            {"name": view, "intrinsics": k, "extrinsics": e}
            for view, k, e in zip(
                views, cameras.intrinsics.tolist(), cameras.extrinsics.tolist(), strict=True
            )
        ],
        "path": [list(shift) for shift in path],
        "fps": fps,
    }
    text = files("ghgs_lit.prediction.export").joinpath("page.html").read_text()
    values = {
        "title": html.escape(name),
        # "<!--", "<script" and "</" mean something inside a script, too.
        "scene": json.dumps(scene).replace("<", "\\u003c"),
        "data": "\n".join(base64.b64encode(instant).decode() for instant in packed),
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda name: values[name[1]], text)
