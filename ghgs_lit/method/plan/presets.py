"""Presets that leave out patches and pixels."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal, NamedTuple

from ghgs_lit.config.options import Amount, Options, Patches, Text
from ghgs_lit.types import DecodedPixels


class KeptTokens(NamedTuple):
    """The ``tokens`` and ``margin`` of an encoder; the margin is 0 with all tokens."""

    tokens: str
    margin: int = 0

    @classmethod
    def of_budget(cls, budget: str | int) -> "KeptTokens":
        """The view for one choice of ``token_budgets``.

        Args:
            budget: number of patches around the subject that stay;
                or a value of ``tokens``, such as ``all``.
        """
        return cls("subject", budget) if isinstance(budget, int) else cls(budget)


@contextmanager
def seeing(encoder: Any, view: KeptTokens) -> Iterator[None]:
    """Changes the patches that an encoder keeps within the context.

    Args:
        encoder: a :class:`ghgs_lit.method.encoder.VGGTEncoder`.
        view: its ``tokens`` and ``margin``.
    """
    before = (encoder.tokens, encoder.margin)
    encoder.tokens, encoder.margin = view
    try:
        yield
    finally:
        encoder.tokens, encoder.margin = before


class SkipOptions(Options):
    """Patches and pixels that are not computed, and the accuracy that this may cost."""

    group = "skip"
    name: Text = "exact"
    """Name of the preset, for reports."""
    tokens: Literal["all", "window", "subject"] = "all"
    """Patches that the encoder works on: all, those of the smallest rectangle around the subject
    (window), or the subject's."""
    margin: Patches = 1
    """Patches around the window or the subject that stay."""
    pixels: DecodedPixels = "subject"
    """Pixels that the dense heads decode: whole views, or windows around the subject. The depth
    head decodes all where recalibration.tokens=all: all tokens need a depth."""
    budget_db: float | None = 0.001
    """Largest allowed loss of PSNR compared with skip=none, in dB (`ghgs benchmark` checks it);
    null: no promise."""
    max_rel_diff: Amount | None = 1e-5
    """Largest difference of 99 of 100 values of an attribute or a render from skip=none, as a share
    of the largest value, times the factor by which the model amplifies one rounding of the images;
    `ghgs benchmark` checks it. null: nothing is promised."""
