"""Composed configurations that several tests read."""

import functools

from omegaconf import DictConfig, OmegaConf

from ghgs_lit.config import compose


@functools.cache  # composing takes a fifth of a second
def composed(verb: str, *overrides: str) -> DictConfig:
    """The composed configuration of ``ghgs <verb> <overrides>``, read-only."""
    found = compose(verb, overrides)
    OmegaConf.set_readonly(found, True)
    return found


def verb_with(group: str) -> str:
    """A verb with this config group."""
    return "predict" if group == "calibration" else "train"
