"""The bounds stage (not in the paper): near and far of each pixel's ray, from masks and cameras."""

from ghgs_lit.method.bounds.box import NoBounds, SubjectBox
from ghgs_lit.method.bounds.hull import VisualHull

__all__ = ["NoBounds", "SubjectBox", "VisualHull"]
