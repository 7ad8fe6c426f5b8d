"""Inspection of the Gaussian head's outputs; not used by predictions."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ghgs_lit.method.heads.attributes import RawGaussians
from ghgs_lit.method.heads.gaussian import GaussianHead
from ghgs_lit.ops.activation import bounded_tanh

NEAR_LIMIT = 0.95
"""Fraction of ``gaussian_head.offset_limit`` above which an offset counts as being at its limit."""


@contextmanager
def collect_attributes(head: nn.Module | None) -> Iterator[list[RawGaussians]]:
    """Collect the raw attributes that a head activates within the context, in the order of calls.

    The last ones are those of the prediction: rounds change them, and downsampled images pass through
    the stages first.

    Args:
        head: the stage; for None or a custom head, nothing is collected.
    """
    seen: list[RawGaussians] = []
    if not isinstance(head, GaussianHead):
        yield seen
        return
    activate = head.activate

    def note(raw: RawGaussians, *arguments: Any) -> Any:
        seen.append(raw)
        return activate(raw, *arguments)

    head.activate = note
    try:
        yield seen
    finally:
        del head.activate


@torch.no_grad()
def offsets_at_limit(raw: RawGaussians) -> Float[Tensor, ""]:
    """Fraction of Gaussians, in [0, 1], with an offset along an axis above :data:`NEAR_LIMIT` of the
    limit; 0 without Gaussians.

    Such offsets have lost nine tenths of their gradient, and the surface may lie beyond the limit.

    Args:
        raw: attributes of a head with ``gaussian_head.offset_limit``.
    """
    at_limit = (bounded_tanh(raw.offset).abs() > NEAR_LIMIT).any(-1)
    return at_limit.sum() / max(len(at_limit), 1)
