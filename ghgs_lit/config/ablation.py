"""The rows of the paper's ablation, read from what a model does."""

from collections.abc import Mapping
from typing import Any

#: The ablation's name by its switches (3D unprojection, semantic consistency), in the tables' order.
ABLATIONS = {
    (False, False): "neither",
    (False, True): "no_unprojection",
    (True, False): "no_semantic",
    (True, True): "full",
}


def switches_of(config: Mapping[str, Any]) -> tuple[bool, bool]:
    """Whether the model of ``config`` finds neighbours in 3D, and weights attention by similarity."""
    recalibration = config["recalibration"]
    # A class of the user's own may have other keys.
    return recalibration.get("neighborhood", "xyz") == "xyz", recalibration.get("similarity") != "none"


def ablation_of(config: Mapping[str, Any]) -> str:
    """The name of a model's row in the ablation table; arguments as for :func:`switches_of`."""
    return ABLATIONS[switches_of(config)]
