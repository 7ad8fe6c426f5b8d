"""The recalibration stage: attention across views between tokens that are close in space."""

from ghgs_lit.method.recalibration.attention import SemanticAttention
from ghgs_lit.method.recalibration.neighbors import nearest_neighbors
from ghgs_lit.method.recalibration.recalibration import Recalibration, RecalibrationOptions

__all__ = ["Recalibration", "RecalibrationOptions", "SemanticAttention", "nearest_neighbors"]
