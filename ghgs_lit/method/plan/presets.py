"""Presets for skipping patches and pixels."""

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
        """The setting for one value of ``token_budgets``.

        Args:
            budget: margin of patches around the subject, or a value of ``tokens``, such as ``all``.
        """
        return cls("subject", budget) if isinstance(budget, int) else cls(budget)


@contextmanager
def keep_patches(encoder: Any, view: KeptTokens) -> Iterator[None]:
    """Context in which an encoder keeps other patches.

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
    """Patches and pixels to skip, and the accuracy that this may cost."""

    group = "skip"
    name: Text = "exact"
    """Name of the preset, for reports."""
    tokens: Literal["all", "window", "subject"] = "all"
    """Patches that the encoder processes: all | window: those of the subject's bounding box | subject:
    those with a pixel of the subject."""
    margin: Patches = 1
    """Number of patches around the window or the subject that are kept, too."""
    pixels: DecodedPixels = "subject"
    """Pixels that the dense heads decode: all: whole views | subject: windows around it. The depth head
    decodes all with recalibration.tokens=all, since all tokens need a depth."""
    budget_db: float | None = 0.001
    """Largest allowed loss of PSNR compared with skip=none, in dB, checked by `ghgs benchmark`; null: not
    checked."""
    max_rel_diff: Amount | None = 1e-5
    """Largest allowed difference from skip=none of 99 of 100 values of an attribute or a render, as a
    fraction of the largest value, per unit of the model's amplification of one rounding of the images;
    checked by `ghgs benchmark`; null: not checked."""
