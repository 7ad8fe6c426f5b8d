"""Outputs of the Gaussian head, for inspection; predictions do not use them."""

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
"""Share of ``gaussian_head.offset_limit`` from which on an offset counts as at its limit."""


@contextmanager
def seen_attributes(head: nn.Module | None) -> Iterator[list[RawGaussians]]:
    """Collects the raw attributes that a head activates within the context.

    Args:
        head: The stage; for None or a custom head, nothing is collected.

    Yields:
        Raw attributes in the order of calls. The last ones are those of the prediction: rounds
        change them, and downsampled images pass through the stages first.
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
    """Share of Gaussians whose offset is at its limit.

    Args:
        raw: Attributes of N Gaussians of a head with ``gaussian_head.offset_limit``.

    Returns:
        Share, in [0, 1], of the Gaussians that are moved along an axis by more than ``NEAR_LIMIT``
        of the limit; 0 without Gaussians. Such offsets have lost nine tenths of their gradient, and
        the surface may lie beyond the limit.
    """
    at_limit = (bounded_tanh(raw.offset).abs() > NEAR_LIMIT).any(-1)
    return at_limit.sum() / max(len(at_limit), 1)
