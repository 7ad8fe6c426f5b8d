"""``ghgs view``: show a prediction with its photographs and cameras in the browser."""

import ipaddress
import math
import time
from functools import partial

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


def run(cfg: DictConfig) -> None:
    """Show ``path``; without it predict first, or with ``live`` again and again. Ctrl-C ends it."""
    has_source = cfg.live or any(cfg.get(key) is not None for key in ("path", "checkpoint", "images"))
    require(has_source, "path", "a directory of ghgs predict or a PLY, or checkpoint=<file>", None)
    is_folder = not isinstance(cfg.images, DictConfig)
    require(cfg.live or is_folder, "images", "a folder, or live=true beside cameras", cfg.images)
    if cfg.path is None and cfg.checkpoint is None:
        cfg.checkpoint = SHIPPED
    if cfg.live:
        _run_live(cfg)
        return
    if cfg.path is None:
        predict.run(cfg)
    else:
        save_config(cfg, output_dir())
    # A new prediction is already in the frame of ``up``, and its cameras tell which axis that is.
    viewer = _opened(cfg, read_content(cfg.path or output_dir(), cfg.up if cfg.path else None))
    end = time.monotonic() + (cfg.seconds or math.inf)
    try:
        while time.monotonic() < end:
            time.sleep(0.2)
    finally:
        viewer.stop()


@torch.no_grad()
def _run_live(cfg: DictConfig) -> None:
    require(cfg.path is None, "path", "null with live=true", cfg.path)
    config, pause = resolve(cfg), Pause()
    frames = live_frames(**sources_of(config), sleep=pause)
    config |= model_of(config["checkpoint"], cfg)
    options, device = output_options(config), pick_device(config["device"])
    renderer, model = build_renderer(config, device), load_model(config, device)
    size = crop_size(config["size"], read_config(config["checkpoint"]), model)
    write_config(config, output_dir())
    # To decide at each instant what ``auto`` should refine would take as long as a prediction.
    masks, cameras = (0 if n == "auto" else n for n in (config["refine_masks"], config["refine_cameras"]))
    forward = partial(in_frame, model)
    temporal = Temporal(forward, model.skip.every, renderer)

    def predicted(batch: Batch) -> ExportedSubject:
        batch = batch.to(device)
        result = predict_batch(batch, model, renderer, cameras, config["refine"], forward, temporal)
        return exported_subject(result.batch, result.prediction, renderer, options)

    crop = partial(Capture.batch, size=size, refine_masks=masks)
    recording = None if config["out"] is None else Recording(resolved(config["out"]))
    print(f"waiting for an instant in {config['images']}", flush=True)
    page = partial(_opened, cfg, layers=False)
    until, delay = cfg.seconds or math.inf, cfg.delay or math.inf
    show_live(frames, pause, crop, predicted, page, recording, until, delay)


def _opened(cfg: DictConfig, content: Content, layers: bool = True) -> Viewer:
    viewer = Viewer(content, cfg.host, cfg.port, layers)
    print(f"viewer: {viewer.address} ({_reach(cfg.host)}); Ctrl-C ends it", flush=True)
    return viewer


def _reach(host: str) -> str:
    try:
        is_own = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_own = False
    return "for this machine only; host=0.0.0.0 opens it to the network" if is_own else "open to the network"
