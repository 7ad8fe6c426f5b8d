"""The recalibration stage: attention across views among tokens that are close in space."""

from ghgs_lit.recalibration.attention import SIMILARITIES, SemanticAttention
from ghgs_lit.recalibration.neighbors import MODES, Neighbors, nearest_neighbors
from ghgs_lit.recalibration.recalibration import Recalibration

__all__ = ["MODES", "SIMILARITIES", "Neighbors", "Recalibration", "SemanticAttention", "nearest_neighbors"]
