"""The encode stage: VGGT's aggregator over patch tokens, of any size."""

from ghgs_lit.encoder.encoder import VGGTEncoder, VGGTOptions

__all__ = ["VGGTEncoder", "VGGTOptions"]
