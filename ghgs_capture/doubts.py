"""Quick checks of a capture: do photographs contradict masks, or silhouettes cameras?"""

import numpy as np

from ghgs_capture.capture import Capture
from ghgs_capture.crops import SHARE, Photograph
from ghgs_lit.geometry.frame import Frame
from ghgs_lit.geometry.masks import signed_distance
from ghgs_lit.refinement.coherence import contradiction
from ghgs_lit.types import Batch

CORRECTION = 4  #: Pixels of masks, and rounds of cameras, for correcting what is found
_REACH = 6  #: Pixels beside an outline in which contrast is measured
#: Mean pixels of crops from masks' outlines to the photographs', above which masks are off.
_OFF = 0.35
#: Mean pixels by which rays near outlines miss other silhouettes, above which cameras are off.
_MISSED = 4e-3
#: The same where the others agree without one camera, or without either of two
_MISSED_BY_FEW = 1.5e-3
_REST = 0.25  #: Share of the distance that the others have where one camera may be to blame


def doubt_of_masks(capture: Capture, size: tuple[int, int]) -> str:
    """Say where photographs show outlines, if they contradict the masks.

    Args:
        capture: photographs with their masks.
        size: (height, width) of the crops in pixels.

    Returns:
        Pixels of a crop from each mask's outline inward to the photograph's; "" where masks are
        right.
    """
    off = [_outline(photograph, size) for photograph in capture.photographs]
    if np.abs(off).mean() <= _OFF:
        return ""
    return f"photographs show outlines {', '.join(f'{n:+.1f}' for n in off)} pixels inside the masks'"


def doubt_of_cameras(capture: Capture, batch: Batch) -> str:
    """Say by how much silhouettes miss one another, if cameras are off.

    It is also said without which cameras they do not: one, or two that are nearly exchangeable, as
    opposite ones are.

    Args:
        capture: photographs with their cameras.
        batch: its crops, of one element.

    Returns:
        The message; "" where cameras are right.
    """
    missed, without = (distances[0].tolist() for distances in contradiction(Frame.of(batch).enter(batch)))
    focal = [photograph.intrinsics[0, 0] for photograph in capture.photographs]
    # An enlarged photograph has larger pixels, and larger steps of outlines.
    larger = max(1.0, *(batch.cameras.intrinsics[0, :, 0, 0].numpy() / focal))
    rest = {}
    for name, distance in zip(batch.views[0], without, strict=True):
        if distance < _REST * missed:
            rest[name] = distance
    is_of_few = 0 < 2 * len(rest) <= len(without)
    if missed <= larger**2 * (_MISSED_BY_FEW if is_of_few else _MISSED):
        return ""
    without_few = f", without {' or '.join(rest)} by {max(rest.values()):.4f}" if is_of_few else ""
    return f"silhouettes miss one another by {missed:.4f} pixels{without_few}"


def _outline(photograph: Photograph, size: tuple[int, int]) -> float:
    """Pixels of the crop inside the mask's outline at which the photograph has the
    most contrast."""
    extents = photograph.extents
    steps = [(end - start) / (SHARE * side) for (start, end), side in zip(extents, size, strict=True)]
    step = max(*steps, 1)
    reach = (_REACH + 2) * step
    # One pixel of the photograph for each of the crop: fast, and edges stay where they are.
    lines = [
        np.arange(max(start - reach, 0), min(end - 1 + reach, whole - 1) + 0.5, step).astype(int)
        for (start, end), whole in zip(extents, photograph.mask.shape, strict=True)
    ]
    seen = np.ix_(*lines)
    distance = signed_distance(photograph.mask[seen])
    near = np.abs(distance) < _REACH
    if not near.any():
        return 0.0
    slopes = np.gradient(photograph.image[seen].astype(np.float32), axis=(0, 1))
    pairs = zip(slopes, np.gradient(distance), strict=True)
    across = sum(slope[near] * n[near][:, None] for slope, n in pairs)
    lines = np.floor(distance[near]).astype(int) + _REACH
    count = np.maximum(np.bincount(lines, minlength=2 * _REACH), 1)
    contrast = np.bincount(lines, np.abs(across).sum(-1), 2 * _REACH) / count
    # The lines of pixels on either side of an edge, and those beside them,
    # give fractions of a pixel.
    first = int((contrast[1:-2] + contrast[2:-1]).argmax())
    around = contrast[first : first + 4]
    middle = (around * np.arange(4)).sum() / max(around.sum(), 1e-6)
    return float(first + middle - _REACH + 0.5) * step / max(steps)
