"""``ghgs view``: show a prediction with its photographs and cameras in the browser."""

import ipaddress
import math
import time
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

import torch

from ghgs_capture.capture import Capture
from ghgs_capture.export import output_options
from ghgs_capture.export.subject import ExportedSubject, exported_subject
from ghgs_capture.live import live_frames
from ghgs_capture.prediction import crop_size, in_frame, predict_batch
from ghgs_capture.temporal import Temporal
from ghgs_capture.verbs import predict
from ghgs_capture.verbs.photographs import sources_of
from ghgs_capture.viewer.content import Content, read_content
from ghgs_capture.viewer.live import Pause, Recording, show_live
from ghgs_capture.viewer.server import Viewer
from ghgs_lit.cli.inputs import build_renderer, load_model, model_of, pick_device
from ghgs_lit.cli.runtime import output_dir, write_config
from ghgs_lit.errors import require
from ghgs_lit.files import resolved
from ghgs_lit.types import Batch
from ghgs_lit.weights.checkpoint import read_config
from ghgs_lit.weights.reading import SHIPPED

if TYPE_CHECKING:
    from ghgs_capture.verbs import View


def run(verb: "View") -> None:
    """Show ``path``; without it predict first, or with ``live`` again and again. Ctrl-C ends it.

    Args:
        verb: the run.

    Raises:
        InputError: there is nothing to show, or a file or option is wrong.
    """
    sources = (verb.path, verb.checkpoint, verb.images)
    has_source = verb.live or any(source is not None for source in sources)
    require(has_source, "path", "a directory of ghgs predict or a PLY, or checkpoint=<file>", None)
    is_folder = not isinstance(verb.images, Mapping)
    require(verb.live or is_folder, "images", "a folder, or live=true beside cameras", verb.images)
    if verb.path is None and verb.checkpoint is None:
        verb = verb.replace(checkpoint=SHIPPED)
    if verb.live:
        _run_live(verb)
        return
    if verb.path is None:
        predict.run(verb)
    else:
        write_config(verb, output_dir())
    # A new prediction is already in the frame of ``up``, and its cameras tell which axis that is.
    content = read_content(verb.path or output_dir(), verb.up if verb.path else None)
    viewer = _opened(verb, content)
    end = time.monotonic() + (verb.seconds or math.inf)
    try:
        while time.monotonic() < end:
            time.sleep(0.2)
    finally:
        viewer.stop()


@torch.no_grad()
def _run_live(run: "View") -> None:
    """Predict and show the newest instant again and again."""
    require(run.path is None, "path", "null with live=true", run.path)
    pause = Pause()
    frames = live_frames(**sources_of(run), sleep=pause)
    run = run.replace(**model_of(run.checkpoint, run))
    output = output_options(run)
    device = pick_device(run.device)
    renderer = build_renderer(run, device)
    model = load_model(run.plain, run.checkpoint, device, run.precision)
    size = crop_size(run.size, read_config(run.checkpoint), model)
    write_config(run, output_dir())
    # To decide at each instant what ``auto`` should refine would take as long as a prediction.
    masks = 0 if run.refine_masks == "auto" else run.refine_masks
    cameras = 0 if run.refine_cameras == "auto" else run.refine_cameras
    forward = partial(in_frame, model)
    temporal = Temporal(forward, model.skip.every, renderer)

    def predicted(batch: Batch) -> ExportedSubject:
        batch = batch.to(device)
        result = predict_batch(batch, model, renderer, cameras, run.refine, forward, temporal)
        return exported_subject(result.batch, result.prediction, renderer, output)

    crop = partial(Capture.batch, size=size, refine_masks=masks)
    recording = None if run.out is None else Recording(resolved(run.out))
    print(f"waiting for an instant in {run.images}", flush=True)
    page = partial(_opened, run, layers=False)
    until = run.seconds or math.inf
    delay = run.delay or math.inf
    show_live(frames, pause, crop, predicted, page, recording, until, delay)


def _opened(run: "View", content: Content, layers: bool = True) -> Viewer:
    viewer = Viewer(content, run.host, run.port, layers)
    print(f"viewer: {viewer.address} ({_reach(run.host)}); Ctrl-C ends it", flush=True)
    return viewer


def _reach(host: str) -> str:
    try:
        is_own = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_own = False
    return "for this machine only; host=0.0.0.0 opens it to the network" if is_own else "open to the network"
