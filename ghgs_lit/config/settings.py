"""Sizes of images as configurations say them."""

from collections.abc import Sequence

from ghgs_lit.errors import require


def image_size(key: str, size: int | Sequence[int]) -> tuple[int, int]:
    """(height, width) in pixels from a side or a pair."""
    pair = (size, size) if isinstance(size, int) else tuple(size)
    valid = len(pair) == 2 and all(isinstance(side, int) and side >= 1 for side in pair)
    require(valid, key, "a side or [height, width] in pixels", size)
    return pair
