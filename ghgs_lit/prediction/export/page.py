"""A single HTML file that shows Gaussians in any browser with WebGL 2, without a network."""

import base64
import html
import json
import re
from collections.abc import Sequence
from importlib.resources import files

from torch import Tensor

from ghgs_lit.prediction.export.packed import COARSE, FINE, pack
from ghgs_lit.types import Cameras, Gaussians
from ghgs_lit.visualization.turntable import pixel_size


def page(
    gaussians: Gaussians,
    cameras: Cameras,
    views: Sequence[str],
    up: Tensor,
    center: Tensor,
    name: str,
    packed: Sequence[bytes] = (),
    path: Sequence[Sequence[float]] = ((0.0, 0.0, 0.0),),
    fps: float = 1.0,
) -> str:
    """The text of the page of an instant, or of several that it plays; it has a button for each camera.

    Args:
        gaussians: of one subject, RGB colours; of several instants the first.
        cameras: of the photographs [V]; the page begins at the first.
        up: the unit vector [3] that points up.
        center: the point [3] that it turns about.
        packed: of each of several instants what :func:`pack` gives with ``COARSE`` and the size of pixels at
            ``center``.
        path: how far from the first instant the page's camera moves along with the subject [instants, 3].
        fps: instants a second.
    """
    steps, pixel = COARSE if packed else FINE, pixel_size(cameras, center)
    packed = packed or [pack(gaussians, pixel, center, steps)]
    scene = {
        "size": [cameras.width, cameras.height],
        "up": up.tolist(),
        "target": center.tolist(),
        "pixel": pixel,
        "steps": steps,
        "low_pass": gaussians.low_pass,
        "antialiased": gaussians.antialiased,
        "cameras": [
            {"name": view, "intrinsics": k, "extrinsics": e}
            for view, k, e in zip(
                views, cameras.intrinsics.tolist(), cameras.extrinsics.tolist(), strict=True
            )
        ],
        "path": path,
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
