"""Tiny models of any configuration, for tests of the whole model."""

import copy
import functools

import torch
from omegaconf import OmegaConf
from torch import nn

from ghgs_lit.config import compose
from ghgs_lit.execution import Predictor
from ghgs_lit.method.model import GHGS, STAGES

ATTRIBUTES = ("means", "quaternions", "scales", "opacities", "colors")
TINY = ["encoder.width=32", "encoder.heads=2", "encoder.vit.channels=8"]
TINY += ["recalibration.k=8", "recalibration.num_heads=2"]


def config(*overrides):
    """The configuration nodes of a tiny model, as plain data."""
    return copy.deepcopy(_composed(overrides))


@functools.cache  # composing costs more than the tiny models
def _composed(overrides):
    # By default, the model whose stages have the most inputs.
    chosen = [] if any(override.startswith("model=") for override in overrides) else ["model=hull"]
    composed = compose("train", [*TINY, *chosen, *overrides])
    nodes = [*STAGES, "skip", "model", "compat"]
    nodes += ["rounds"] * ("rounds" in composed)
    return OmegaConf.to_container(OmegaConf.masked_copy(composed, nodes), resolve=True)


def make_model(*overrides, seed=0):
    """A tiny model moved from its initial state, in which many outputs are constant."""
    torch.manual_seed(seed)
    model = GHGS.from_config(config(*overrides))
    for last in (
        model.depth_head.dpt.scratch.output_conv2[-1],
        *(
            getattr(model.gaussian_head, name)[-1]
            for name in ("offset_header", "scale_header", "rot_header", "opacity_header")
        ),
    ):
        nn.init.normal_(last.weight, std=0.5)
    return model


def predict(model, batch):
    """The prediction of a model for a batch."""
    return Predictor(model)(batch)


def load_model(*arguments, **options):
    """The model of a checkpoint."""
    return Predictor.from_checkpoint(*arguments, **options).model


def close(a, b, limit=1e-5):
    """Assert that Gaussians differ by at most ``limit`` times an attribute's largest absolute value."""
    for name in ATTRIBUTES:
        x, y = getattr(a, name), getattr(b, name)
        assert (x - y).abs().max() <= limit * y.abs().max(), name
