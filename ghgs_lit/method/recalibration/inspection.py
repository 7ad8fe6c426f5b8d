"""Inspection of neighbours; not used by predictions."""

import copy
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import nn

from ghgs_lit.method.recalibration.recalibration import Recalibration
from ghgs_lit.types import Points, Tokens


@torch.no_grad()
def shared_neighbors(recalibration: Recalibration, tokens: Tokens, points: Points) -> list[float]:
    """Share of each element's neighbours that are the same with the other ``neighborhood`` setting.

    With nearly all tokens as neighbours it is close to 1, and the ablation of 3D unprojection hardly
    changes anything.

    Args:
        recalibration: the stage.
        tokens: input of the stage.
        points: points of these tokens.
    """
    other = copy.copy(recalibration)
    other.neighborhood = "image_plane" if recalibration.neighborhood == "xyz" else "xyz"
    pair = (recalibration, other)
    takes_part = recalibration.takes_part(points)
    element = tokens.image // tokens.grid[1]
    shares = []
    for number in range(tokens.grid[0]):
        chosen = (takes_part & (element == number)).nonzero()[:, 0]
        near, changed = (stage.neighborhood_of(tokens, points, chosen).near for stage in pair)
        is_near = near.new_zeros(len(chosen), len(chosen), dtype=torch.bool).scatter_(1, near, True)
        shares.append(is_near.gather(1, changed).float().mean().item() if len(chosen) else 1.0)
    return shares


#: Arguments of :func:`shared_neighbors`: a stage and its inputs.
Call = tuple[Recalibration, Tokens, Points]


@contextmanager
def collect_calls(recalibration: nn.Module | None) -> Iterator[list[Call]]:
    """Collect the inputs of the stage's calls within the context, appended to the yielded list.

    Nothing is computed, so measured run times are unaffected.

    Args:
        recalibration: the stage; for None, or one without neighbours, the list stays empty.
    """
    calls: list[Call] = []
    if not isinstance(recalibration, Recalibration):
        yield calls
        return
    hook = recalibration.register_forward_pre_hook(lambda stage, inputs: calls.append((stage, *inputs[:2])))
    try:
        yield calls
    finally:
        hook.remove()
