"""``ghgs prepare``: render people or scans into training data, make a miniature, or check what is there."""

import logging
from pathlib import Path

from omegaconf import DictConfig
from rich.console import Console
from rich.progress import track

from ghgs_lit.cli.runtime import announce
from ghgs_lit.config import build
from ghgs_lit.data.datamodule import PHASES, RenderedDataModule, ScansDataModule
from ghgs_lit.errors import choice

log = logging.getLogger(__name__)


def run(cfg: DictConfig) -> None:
    """The verb; prints the root of the data last."""
    choice("task", cfg.task, ("render", "miniature", "check"))
    data = build(cfg.data, _key="data", views=cfg.views, targets=cfg.targets, seed=cfg.seed)
    root = Path(data.root or ".").expanduser().resolve()
    if cfg.task == "render":
        render(data)
        announce(root)
    elif cfg.task == "miniature":
        miniature = cfg.miniature
        for folder in data.miniature(dict(miniature.people), miniature.size, cfg.seed):
            announce(folder)
    else:
        check(data)
        print(root)


def render(data: RenderedDataModule) -> None:
    """Make what is missing, then see that it reads back."""
    if isinstance(data, ScansDataModule):
        data.render_scans()
    else:
        data.prepare_data()
    for phase in PHASES:
        log.info("%s: %d subjects", phase, len(data.subjects(phase)))


def check(data: RenderedDataModule) -> None:
    """Read every photograph, mask, depth map, camera and body.

    Raises:
        InputError: the first one that is bad, missing or does not fit.
    """
    for phase in PHASES:
        layout = data.assembler(phase).inputs
        photos = [(name, pid) for name, pids in layout.subjects.items() for pid in pids]
        for name, pid in track(photos, f"checking {phase}", console=Console(stderr=True)):
            for vid in layout.vids(name, pid):
                layout.view(name, pid, vid)
        bodies = sum(layout.body(name) is not None for name in layout.subjects)
        log.info("%s: %d subjects, %d with a body, all sound", phase, len(layout.subjects), bodies)
