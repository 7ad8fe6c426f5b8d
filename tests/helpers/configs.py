"""Composed configurations, which several tests look at."""

import functools

from omegaconf import DictConfig, OmegaConf

from ghgs_lit.config import compose


@functools.cache  # composing takes a fifth of a second
def composed(verb: str, *overrides: str) -> DictConfig:
    """``ghgs <verb> <overrides>`` as it is composed; nobody can change it."""
    found = compose(verb, overrides)
    OmegaConf.set_readonly(found, True)
    return found


def verb_with(group: str) -> str:
    """A verb that has a config group."""
    return "predict" if group == "calibration" else "train"
