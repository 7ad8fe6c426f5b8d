"""The encode stage: VGGT's aggregator of any size over patch tokens."""

from ghgs_lit.encoder.encoder import VGGTEncoder
from ghgs_lit.encoder.options import VGGTOptions

__all__ = ["VGGTEncoder", "VGGTOptions"]
