"""``ghgs view``: show a prediction with its photographs and cameras in the browser."""

import ipaddress
import math
import time

from omegaconf import DictConfig

from ghgs_lit.cli import predict
from ghgs_lit.cli.runtime import output_dir, save_config
from ghgs_lit.errors import require
from ghgs_lit.prediction.viewer.content import read_content
from ghgs_lit.prediction.viewer.server import Viewer
from ghgs_lit.weights.reading import SHIPPED


def run(cfg: DictConfig) -> None:
    """Show ``path``; without it predict first. Ctrl-C ends it."""
    has_source = any(cfg.get(key) is not None for key in ("path", "checkpoint", "images"))
    require(has_source, "path", "a directory of ghgs predict or a PLY, or checkpoint=<file>", None)
    if cfg.path is None:
        cfg.checkpoint = cfg.checkpoint or SHIPPED
        predict.run(cfg)
    else:
        save_config(cfg, output_dir())
    # A new prediction is already in the frame of ``up``, and its cameras tell which axis that is.
    content = read_content(cfg.path or output_dir(), cfg.up if cfg.path else None)
    viewer = Viewer(content, cfg.host, cfg.port)
    print(f"viewer: {viewer.address} ({_reach(cfg.host)}); Ctrl-C ends it", flush=True)
    end = time.monotonic() + (cfg.seconds or math.inf)
    try:
        while time.monotonic() < end:
            time.sleep(0.2)
    finally:
        viewer.stop()


def _reach(host: str) -> str:
    try:
        is_own = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        is_own = False
    return "for this machine only; host=0.0.0.0 opens it to the network" if is_own else "open to the network"
