"""How a model runs: checks of its inputs, the subject's frame, padding, precision, coarse to fine,
and capture as CUDA graphs. The model and its stages do not depend on it."""

from ghgs_lit.execution.options import ModelOptions
from ghgs_lit.execution.predictor import Predictor

__all__ = ["ModelOptions", "Predictor"]
