"""The encode stage: VGGT's aggregator over patch tokens, of any size."""

from ghgs_lit.encoder.cache import FeatureCache, PhotographCache, open_cache
from ghgs_lit.encoder.encoder import VGGTEncoder

__all__ = ["FeatureCache", "PhotographCache", "VGGTEncoder", "open_cache"]
