"""Encoders of any size."""

from ghgs_lit.encoder import VGGTEncoder, VGGTOptions


def make_encoder(tokens: str = "all", margin: int = 1, **options) -> VGGTEncoder:
    """The encoder of ``options``, which sees ``tokens`` and ``margin``."""
    return VGGTOptions(**options).build(tokens, margin)
