"""What the places of cameras tell about a capture before anything is predicted: numbers that are
too coarse, photographs from one direction, sides that none shows, and copies of a photograph."""

import itertools
from collections.abc import Sequence

import numpy as np

from ghgs_capture.crops import Photograph
from ghgs_lit.geometry.silhouettes import Silhouette, subject_sphere

_SIDE = 500  #: Longer side of photographs whose pixels are told
#: Pixels by which rounding to float32 may move a camera's picture.
_COARSE = 0.25
#: Degrees between the two most different views below which depth is a guess.
_NARROW = 10.0
#: Degrees around the subject between neighbouring cameras above which a side of it is seen by none;
#: four cameras evenly around have 90.
_GAP = 100.0
# Two copies of a photograph, stored with losses: least common share of their masks, and mean
# difference of levels of 255 within them.
_SAME = 0.98
_ALIKE = 2.0


def copies(photographs: Sequence[Photograph]) -> tuple[str, str] | None:
    """Find two photographs that are the same picture, also if stored with losses.

    Args:
        photographs: of one instant, with their mattes.

    Returns:
        Their names; None: there are none.
    """
    for one, other in itertools.combinations(photographs, 2):
        if one.image.shape != other.image.shape:
            continue
        both = one.mask & other.mask
        either = one.mask | other.mask
        differences = np.abs(one.image.astype(np.int16) - other.image)[both]
        if both.sum() > _SAME * either.sum() and differences.mean() < _ALIKE:
            return one.name, other.name
    return None


def placement_lines(photographs: Sequence[Photograph], stored: Sequence[np.ndarray]) -> list[str]:
    """Say where cameras may lead to a poor prediction.

    Args:
        photographs: of one instant, with their cameras.
        stored: the poses [4, 4] as their file has them.

    Returns:
        Lines of text; none for an ordinary ring of four cameras or more.
    """
    silhouettes = [Silhouette(p.mask, p.intrinsics, p.extrinsics) for p in photographs]
    focus, _ = subject_sphere(silhouettes)
    toward = np.stack([silhouette.center for silhouette in silhouettes]) - focus
    lines = [*_coarse(photographs, stored, np.linalg.norm(toward, axis=1))]
    sight = toward / np.linalg.norm(toward, axis=1, keepdims=True).clip(1e-12)
    spread = np.degrees(np.arccos((sight @ sight.T).clip(-1, 1))).max()
    if spread < _NARROW:
        lines.append(f"all photographs are from within {spread:.2g} degrees: depth is a guess")
        return lines
    gap, before, after = _largest_gap(photographs, sight)
    if gap > _GAP:
        lines.append(
            f"no camera for {gap:.0f} degrees between {before} and {after}: what only that side"
            " shows is a guess, and one more camera there helps most"
        )
    return lines


def _coarse(
    photographs: Sequence[Photograph], stored: Sequence[np.ndarray], distances: np.ndarray
) -> list[str]:
    """A line where poses have the precision of float32 far from the world's origin."""
    far = np.array([np.linalg.norm(photograph.extrinsics[:3, 3]) for photograph in photographs])
    sides = np.array([max(photograph.mask.shape) for photograph in photographs])
    focal = np.array([photograph.intrinsics[0, 0] for photograph in photographs]) * _SIDE / sides
    off = float((np.finfo(np.float32).eps * far / distances.clip(1e-12) * focal).max())
    if off < _COARSE or not all(map(_is_float32, np.stack(stored)[:, :3, 3].ravel())):
        return []
    return [
        f"cameras are {far.max():.2g} units from the world's origin, in float32: off by up to"
        f" {off:.1g} of {_SIDE} pixels; float64, or a nearer origin, has none of this"
    ]


def _is_float32(number: float) -> bool:
    """Whether a number is one of float32, or the shortest decimals of one."""
    return number in (float(np.float32(number)), float(str(np.float32(number))))


def _largest_gap(photographs: Sequence[Photograph], sight: np.ndarray) -> tuple[float, str, str]:
    """Degrees around the subject, and the cameras on either side."""
    up = -np.mean([photograph.extrinsics[1, :3] for photograph in photographs], 0)
    up /= max(np.linalg.norm(up), 1e-12)
    first = sight[0] - (sight[0] @ up) * up
    across = np.cross(up, first)
    angles = np.degrees(np.arctan2(sight @ across, sight @ first)) % 360
    order = angles.argsort()
    gaps = np.diff(angles[order], append=angles[order[0]] + 360)
    widest = int(gaps.argmax())
    names = [photographs[order[place % len(order)]].name for place in (widest, widest + 1)]
    return float(gaps[widest]), *names
