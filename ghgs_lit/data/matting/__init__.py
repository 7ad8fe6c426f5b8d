"""Mattes of photographs whose masks are a few pixels off, ragged or have holes."""

from ghgs_lit.data.matting.mattes import refined_matte

__all__ = ["refined_matte"]
