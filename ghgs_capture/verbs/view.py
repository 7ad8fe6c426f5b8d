"""``ghgs view``: show a prediction with its photographs and cameras in the browser."""

import ipaddress
import math
import time
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

import torch
from omegaconf import DictConfig

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
from ghgs_lit.cli.runtime import output_dir, save_config, write_config
from ghgs_lit.config import resolve
from ghgs_lit.errors import require
from ghgs_lit.files import resolved
from ghgs_lit.types import Batch
from ghgs_lit.weights.checkpoint import read_config
from ghgs_lit.weights.reading import SHIPPED

if TYPE_CHECKING:
    from ghgs_capture.verbs import View


def run(options: "View", cfg: DictConfig) -> None:
    """Show ``path``; without it predict first, or with ``live`` again and again. Ctrl-C ends it.

    Args:
        options: of the verb.
        cfg: the whole configuration; gets the weights that are used where none are named.

    Raises:
        InputError: there is nothing to show, or a file or option is wrong.
    """
    sources = (options.path, options.checkpoint, options.images)
    has_source = options.live or any(source is not None for source in sources)
    require(has_source, "path", "a directory of ghgs predict or a PLY, or checkpoint=<file>", None)
    is_folder = not isinstance(options.images, Mapping)
    require(options.live or is_folder, "images", "a folder, or live=true beside cameras", options.images)
    if options.path is None and options.checkpoint is None:
        cfg.checkpoint = SHIPPED
        options = options.replace(checkpoint=SHIPPED)
    if options.live:
        _run_live(options, cfg)
        return
    if options.path is None:
        predict.run(options, cfg)
    else:
        save_config(cfg, output_dir())
    # A new prediction is already in the frame of ``up``, and its cameras tell which axis that is.
    content = read_content(options.path or output_dir(), options.up if options.path else None)
    viewer = _opened(options, content)
    end = time.monotonic() + (options.seconds or math.inf)
    try:
        while time.monotonic() < end:
            time.sleep(0.2)
    finally:
        viewer.stop()


@torch.no_grad()
def _run_live(options: "View", cfg: DictConfig) -> None:
    """Predict and show the newest instant again and again."""
    require(options.path is None, "path", "null with live=true", options.path)
    config = resolve(cfg)
    pause = Pause()
    frames = live_frames(**sources_of(config), sleep=pause)
    config |= model_of(options.checkpoint, cfg)
    output = output_options(options)
    device = pick_device(options.device)
    renderer = build_renderer(config, device)
    model = load_model(config, device)
    size = crop_size(options.size, read_config(options.checkpoint), model)
    write_config(config, output_dir())
    # To decide at each instant what ``auto`` should refine would take as long as a prediction.
    masks = 0 if options.refine_masks == "auto" else options.refine_masks
    cameras = 0 if options.refine_cameras == "auto" else options.refine_cameras
    forward = partial(in_frame, model)
    temporal = Temporal(forward, model.skip.every, renderer)

    def predicted(batch: Batch) -> ExportedSubject:
        batch = batch.to(device)
        result = predict_batch(batch, model, renderer, cameras, options.refine, forward, temporal)
        return exported_subject(result.batch, result.prediction, renderer, output)

    crop = partial(Capture.batch, size=size, refine_masks=masks)
    recording = None if options.out is None else Recording(resolved(options.out))
    print(f"waiting for an instant in {options.images}", flush=True)
    page = partial(_opened, options, layers=False)
    until = options.seconds or math.inf
    delay = options.delay or math.inf
    show_live(frames, pause, crop, predicted, page, recording, until, delay)


def _opened(options: "View", content: Content, layers: bool = True) -> Viewer:
    viewer = Viewer(content, options.host, options.port, layers)
    print(f"viewer: {viewer.address} ({_reach(options.host)}); Ctrl-C ends it", flush=True)
    return viewer


def _reach(host: str) -> str:
    try:
        is_own = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_own = False
    return "for this machine only; host=0.0.0.0 opens it to the network" if is_own else "open to the network"
