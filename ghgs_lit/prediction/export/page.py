"""A single HTML file that shows Gaussians in any browser with WebGL 2, without a network."""

import base64
import gzip
import html
import json
import re
from collections.abc import Sequence
from importlib.resources import files

from torch import Tensor

from ghgs_lit.prediction.export.compact import to_records
from ghgs_lit.types import Cameras, Gaussians
from ghgs_lit.visualization.turntable import pixel_size


def page(
    gaussians: Gaussians, cameras: Cameras, views: Sequence[str], up: Tensor, center: Tensor, name: str
) -> str:
    """The text of the page, which begins at the first camera, and has a button for each.

    Args:
        gaussians: of one subject, RGB colours.
        cameras: of the photographs [V].
        up: the unit vector [3] that points up.
        center: the point [3] that it turns about.
    """
    scene = {
        "size": [cameras.width, cameras.height],
        "up": up.tolist(),
        "target": center.tolist(),
        "pixel": pixel_size(cameras, center),
        "low_pass": gaussians.low_pass,
        "antialiased": gaussians.antialiased,
        "cameras": [
            {"name": view, "intrinsics": k, "extrinsics": e}
            for view, k, e in zip(
                views, cameras.intrinsics.tolist(), cameras.extrinsics.tolist(), strict=True
            )
        ],
    }
    data = base64.b64encode(gzip.compress(to_records(gaussians).tobytes(), mtime=0)).decode()
    text = files("ghgs_lit.prediction.export").joinpath("page.html").read_text()
    values = {
        "title": html.escape(name),
        # "<!--", "<script" and "</" mean something inside a script, too.
        "scene": json.dumps(scene).replace("<", "\\u003c"),
        "data": data,
    }
    return re.sub(r"\{\{(\w+)\}\}", lambda name: values[name[1]], text)
