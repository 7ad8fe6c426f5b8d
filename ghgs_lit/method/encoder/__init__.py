"""The encoder stage: VGGT's aggregator, of any size, over patch tokens."""

from ghgs_lit.method.encoder.encoder import VGGTEncoder, VGGTOptions

__all__ = ["VGGTEncoder", "VGGTOptions"]
