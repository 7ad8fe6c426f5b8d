"""The first stage: near and far of each pixel's ray, from masks and cameras alone. Not part of the paper."""

from ghgs_lit.bounds.box import NoBounds, SubjectBox
from ghgs_lit.bounds.hull import VisualHull

__all__ = ["NoBounds", "SubjectBox", "VisualHull"]
