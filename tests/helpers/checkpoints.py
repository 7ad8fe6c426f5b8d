"""Checkpoints of a tiny untrained model."""

import torch

from ghgs_lit.weights.checkpoint import FORMAT_VERSION
from tests.helpers.models import config, make_model

TRAINING = {"global_step": 5, "optimizer_states": [], "lr_schedulers": [], "loops": {}, "callbacks": {}}


def content(**changes):
    """Content of a checkpoint of a training, without entries that are None."""
    state = {f"model.{key}": value for key, value in make_model().state_dict().items()}
    made = {"state_dict": state, "config": config(), "format_version": FORMAT_VERSION, **TRAINING, **changes}
    return {key: value for key, value in made.items() if value is not None}


def checkpoint(path, **changes):
    torch.save(content(**changes), path)
    return path
