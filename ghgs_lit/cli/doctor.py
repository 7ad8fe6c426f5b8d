"""``ghgs doctor``: what is wrong, and what would mend it; one module for each task."""

from collections.abc import Callable

from omegaconf import DictConfig

from ghgs_lit.cli import doctor_cameras, doctor_machine, doctor_selfcheck

TASKS: dict[str, Callable[[DictConfig], None]] = {
    "cameras": doctor_cameras.run,
    "machine": doctor_machine.run,
    "selfcheck": doctor_selfcheck.run,
}


def run(cfg: DictConfig) -> None:
    """The verb: one of :data:`TASKS`."""
    TASKS[cfg.task](cfg)
