"""The recalibration stage: attention across views between tokens that are close in space."""

from ghgs_lit.method.recalibration.recalibration import (
    Neighborhood,
    Recalibration,
    RecalibrationOptions,
    SemanticAttention,
)

__all__ = ["Neighborhood", "Recalibration", "RecalibrationOptions", "SemanticAttention"]
