"""``ghgs view``: show a prediction with its photographs and cameras in the browser."""

import math
import time
from typing import TYPE_CHECKING

from ghgs_capture.verbs import predict
from ghgs_capture.viewer.content import read_content
from ghgs_capture.viewer.server import Viewer
from ghgs_lit.cli.runtime import output_dir, write_config
from ghgs_lit.errors import require
from ghgs_lit.weights.reading import SHIPPED

if TYPE_CHECKING:
    from ghgs_capture.verbs import View


def run(verb: "View") -> None:
    """Show ``path``; without it predict first. Ctrl-C ends it.

    Args:
        verb: the run.

    Raises:
        InputError: there is nothing to show, or a file or option is wrong.
    """
    sources = (verb.path, verb.checkpoint, verb.images)
    has_source = any(source is not None for source in sources)
    require(has_source, "path", "a directory of ghgs predict or a PLY, or checkpoint=<file>", None)
    if verb.path is None and verb.checkpoint is None:
        verb = verb.replace(checkpoint=SHIPPED)
    if verb.path is None:
        predict.run(verb)
    else:
        write_config(verb, output_dir())
    # A new prediction is already in the frame of ``up``, and its cameras tell which axis that is.
    content = read_content(verb.path or output_dir(), verb.up if verb.path else None)
    viewer = Viewer(content, verb.host, verb.port)
    print(f"viewer: {viewer.address}; Ctrl-C ends it", flush=True)
    end = time.monotonic() + (verb.seconds or math.inf)
    try:
        while time.monotonic() < end:
            time.sleep(0.2)
    finally:
        viewer.stop()
