"""Execution of a model: input checks, the subject's frame, padding, precision, coarse to fine, and
CUDA-graph capture. The model and its stages do not depend on it."""

from ghgs_lit.execution.options import ModelOptions
from ghgs_lit.execution.predictor import Predictor

__all__ = ["ModelOptions", "Predictor"]
