"""The two searches of the bounds for CPUs: a cell or a ray is left as soon as its answer is known."""

from ghgs_lit.bounds.cpu.search import carve, march
from ghgs_lit.kernels.pool import is_supported

__all__ = ["carve", "is_supported", "march"]
