"""Score how well the masks and cameras of a capture agree (:mod:`ghgs_lit.geometry.silhouettes`), and
find the option of the calibration that makes them agree."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ghgs_capture.calibration import AXES, EXTRINSICS, INTRINSICS, Convention, StoredCamera
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.photographs import Pixels, fits_stored
from ghgs_lit.data.view import area_image, area_mask
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette, median_height

#: Least agreement of every view of a right calibration, and least gain of a better interpretation
AGREES = 0.9
BETTER = 0.05
#: Agreement below which disagreeing views are sought, and the largest share of the disagreement that may
#: remain without them
_SOUND = 0.97
_REST = 1 / 3
_SAME = 0.01  # Insignificant difference of agreement
_SIDE = 320  # Longer side of the photographs that are compared, in pixels
_MIDDLE = (0.3, 0.7)  # Shares of a photograph between which a principal point is plausible
# Usual factors of a resize after the calibration.
_RESIZES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 1.0, 4 / 3, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True)
class StoredView:
    """One downsampled photograph, its camera as stored, and the convention of the camera's numbers."""

    name: str
    camera: StoredCamera
    pixels: Pixels
    mask: np.ndarray
    convention: Convention
    turned: StoredCamera  #: the camera with the other reading of the photograph's EXIF rotation


@dataclass(frozen=True)
class Diagnosis:
    """The report on a calibration."""

    consistent: bool
    line: str


def diagnose(folder: CaptureFolder, instant: str | None = None) -> Diagnosis:
    """Examine the cameras of one instant: as given, then under other interpretations of all cameras, and
    with exchanged cameras.

    Args:
        folder: photographs, masks and calibration.
        instant: one of ``folder.instants``; None: the first.

    Returns:
        Whether cameras and masks agree, with the score and the option or camera to correct.

    Raises:
        InputError: a file cannot be read.
    """
    views = read_small_views(folder, folder.instants[0] if instant is None else instant)
    for one, other in itertools.combinations(views, 2):
        if np.allclose(one.camera.pose, other.camera.pose, rtol=1e-6, atol=1e-6):
            line = f"{one.name} and {other.name} have the same pose: one of them is a copy"
            return Diagnosis(False, line)
    given = _score(folder, views)
    if given >= AGREES:
        height = median_height(_make_silhouettes(folder, views))
        line = (
            f"cameras and masks agree ({given:.0%} of each mask or more lies in the hull of the others);"
            f" the subject is {float(f'{height:.3g}'):g} units tall"
        )
        suspects = _find_suspects(folder, views, given) if given < _SOUND else ""
        return Diagnosis(True, f"{line}; {suspects}" if suspects else line)
    for hypotheses in (_reinterpret(views), _exchange(views)):
        scores = {"": given}
        scores |= {option: _score(folder, changed) for option, changed in hypotheses}
        best = max(scores, key=scores.__getitem__)
        if scores[best] >= max(AGREES, given + BETTER):
            line = f"masks agree by {scores[best]:.0%} instead of {given:.0%} with {best}"
            return Diagnosis(False, line)
    line = f"masks and cameras disagree ({given:.0%} of a mask lies in the hull of the others)"
    return Diagnosis(False, _find_suspects(folder, views, given) or line)


def read_small_views(folder: CaptureFolder, instant: str) -> tuple[StoredView, ...]:
    """Decode the photographs of an instant at a small size, so that many interpretations can be tried.

    Args:
        folder: photographs, masks and calibration.
        instant: one of ``folder.instants``.

    Returns:
        A view for each photograph, with sides of at most ``_SIDE`` pixels.

    Raises:
        InputError: a file cannot be read.
    """
    views = []
    for name, (camera, pixels, matte) in folder.decode(instant).items():
        height, width = pixels.size
        scale = min(_SIDE / max(height, width), 1)
        size = max(round(height * scale), 1), max(round(width * scale), 1)
        # Without a stored size, the intrinsics are for the whole photograph.
        sizes = pixels.size, pixels.stored_size
        keeps_stored = fits_stored(pixels, camera, folder.convention.exif)
        read = camera.with_size(sizes[keeps_stored])
        small = Pixels(area_image(np.ascontiguousarray(pixels.image), *size), None, pixels.turns)
        mask = area_mask(np.ascontiguousarray(matte > 127), *size)
        turned = camera.with_size(sizes[not keeps_stored])
        views.append(StoredView(name, read, small, mask, folder.convention, turned))
    return tuple(views)


def _make_silhouettes(folder: CaptureFolder, views: Sequence[StoredView]) -> list[Silhouette]:
    silhouettes = []
    for view in views:
        matte = view.mask * np.uint8(255)
        photograph = folder.photograph(view.name, view.camera, view.pixels, matte, view.convention)
        silhouettes.append(Silhouette(photograph.mask, photograph.intrinsics, photograph.extrinsics))
    return silhouettes


def _score(folder: CaptureFolder, views: Sequence[StoredView]) -> float:
    """Agreement of the worst view: share of its mask in the hull of the others; 0 if no camera can have
    this interpretation."""
    try:
        return min(HullSearch().shares(_make_silhouettes(folder, views)))
    except (InputError, np.linalg.LinAlgError):
        return 0.0


def _find_suspects(folder: CaptureFolder, views: Sequence[StoredView], score: float) -> str:
    """Describe the views each of which explains most of the disagreement; "" if unclear.

    A mask that lacks a part lies in the hull of the others but removes parts of them from their hulls, so
    the agreement of the others is compared with and without it."""
    if len(views) < 4:  # two views nearly always agree
        return ""
    rest = {out.name: _score(folder, [view for view in views if view is not out]) for out in views}
    best = max(rest.values())
    if best < max(AGREES, 1 - (1 - score) * _REST):
        return ""
    names = " or ".join(name for name, without in rest.items() if without >= best - _SAME)
    return (
        f"{names} disagrees with the others, which agree by {best:.0%} without it and by {score:.0%} with it"
    )


def _reinterpret(views: tuple[StoredView, ...]) -> Iterator[tuple[str, tuple[StoredView, ...]]]:
    """Vary the direction of poses, axes, unit of the intrinsics, resize and EXIF rotation of all cameras;
    yield the options with the views."""
    given = views[0].convention
    readings = [views]
    if any(view.pixels.turns for view in views):
        convention = replace(given, exif="shown" if given.exif == "stored" else "stored")
        turned = (replace(view, camera=view.turned, convention=convention) for view in views)
        readings.append(tuple(turned))
    points = [view.camera.intrinsics[:2, 2] / np.array(view.camera.size)[::-1] for view in views]
    scale = 0.5 / max(float(np.median(points)), 0.01)  # moves principal points to the centre
    likely = min(_RESIZES, key=lambda resize: abs(np.log(resize / scale)))
    meanings = itertools.product(readings, INTRINSICS, (given.resized, likely), EXTRINSICS, AXES)
    for read, intrinsics, resized, extrinsics, axes in meanings:
        numbers = {"intrinsics": intrinsics, "resized": resized, "extrinsics": extrinsics, "axes": axes}
        convention = replace(read[0].convention, **numbers)
        changed = tuple(replace(view, convention=convention) for view in read)
        if convention == given or not all(map(_is_plausible, changed)):
            continue
        changes = []
        for key, value in vars(convention).items():
            if value != getattr(given, key):
                shown = value if isinstance(value, str) else f"{value:.4g}"
                changes.append(f"calibration.{key}={shown}")
        yield " ".join(changes), changed


def _is_plausible(view: StoredView) -> bool:
    """Whether the principal point of a view lies in the central part (``_MIDDLE``) of its photograph."""
    share = view.camera.intrinsics[:2, 2] * view.convention.resized
    if view.convention.intrinsics == "pixels":
        share = share / np.array(view.camera.size)[::-1]
    return bool(((share >= _MIDDLE[0]) & (share <= _MIDDLE[1])).all())


def _exchange(views: tuple[StoredView, ...]) -> Iterator[tuple[str, tuple[StoredView, ...]]]:
    """Exchange two cameras, or all in cycles; yield the options with the views."""
    orders = [views[1:] + views[:1], views[-1:] + views[:-1]]
    for i, j in itertools.combinations(range(len(views)), 2):
        order = list(views)
        order[i], order[j] = views[j], views[i]
        orders.append(order)
    for order in orders:
        pairs = list(zip(views, order, strict=True))
        names = ", ".join(f"{view.name}: {other.name}" for view, other in pairs if view is not other)
        changed = tuple(replace(view, camera=other.camera) for view, other in pairs)
        yield f"'calibration.names={{{names}}}' (or these masks are exchanged)", changed
