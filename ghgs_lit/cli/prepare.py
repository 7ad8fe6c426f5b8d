"""``ghgs prepare``: render people or scans into training data, make a miniature, or check what is there."""

import logging
from pathlib import Path

from omegaconf import DictConfig

from ghgs_lit.cli.runtime import announce, output_dir
from ghgs_lit.config import build
from ghgs_lit.data.check import inspect, show, write
from ghgs_lit.data.datamodule import PHASES, PhotographsDataModule
from ghgs_lit.errors import InputError, choice
from ghgs_lit.synthesis.datamodules import ScansDataModule

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
        check(data, output_dir(), cfg.check.least_iou)


def render(data: PhotographsDataModule) -> None:
    """Make what is missing, then see that it reads back."""
    if isinstance(data, ScansDataModule):
        data.render_scans()
    else:
        data.prepare_data()
    for phase in PHASES:
        log.info("%s: %d subjects", phase, len(data.subjects(phase)))


def check(data: PhotographsDataModule, folder: Path, least_iou: float) -> None:
    """Read everything once; tables on the terminal, ``check.json`` and a contact sheet in ``folder``.

    Raises:
        InputError: training cannot start.
    """
    report = inspect(data, least_iou)
    show(report)
    announce(write(report, folder))
    if report.problems:
        count = len(report.problems)
        raise InputError(f"{data.name}: expected nothing missing or broken; found {count} (see check.json)")
