"""The newest instant of a folder that is being written, predicted and shown in the browser again and again.

    python live.py instants cameras.json [masks]

An instant is a folder with a photograph of every camera, by whatever program takes them; what comes
meanwhile is left out. ``masks`` has the same folders; without it masks lie beside the photographs or are
their alpha channels. Ctrl-C ends it. Needs the extra ``viewer``.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

from ghgs_lit import Capture, predict
from ghgs_lit.errors import InputError
from ghgs_lit.prediction.capture.formats import read_cameras
from ghgs_lit.prediction.viewer.content import Content
from ghgs_lit.prediction.viewer.server import Viewer
from ghgs_lit.visualization.turntable import up_direction


def newest(folder: Path, cameras: Path, masks: Path | None, last: str) -> Capture | None:
    """The newest instant after ``last`` by its name; None: there is none, or it is not whole yet."""
    name = max((path.name for path in folder.iterdir() if path.is_dir()), default="")
    if name <= last:
        return None
    try:
        capture = Capture.read(folder / name, cameras, masks=None if masks is None else masks / name)
    except InputError:  # a file is missing or half written
        return None
    is_whole = len(capture.photographs) == len(read_cameras(cameras).cameras)
    return replace(capture, name=name) if is_whole else None


def main(folder: str, cameras: str, masks: str | None = None) -> None:
    page, last = None, ""
    while True:
        capture = newest(Path(folder), Path(cameras), None if masks is None else Path(masks), last)
        if capture is None:
            time.sleep(0.02)
            continue
        # To look for what should be mended would take as long as a prediction.
        found, last = predict(capture, refine_cameras=0, refine_masks=0), capture.name
        batch = found.batch.to("cpu")
        content = Content(found.gaussians.to("cpu"), up_direction(batch.cameras[0]), batch)
        if page is None:
            page = Viewer(content, layers=False)
            print(page.address, flush=True)
        else:
            page.show(content)
        print(f"{last}: {found.seconds['predict']:.2f} s", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
