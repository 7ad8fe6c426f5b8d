"""Report how well the masks and cameras of a capture agree (:mod:`ghgs_lit.geometry.silhouettes`), and
which other interpretation of the calibration (:class:`Hypothesis`) makes them agree."""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ghgs_capture.calibration import AXES, EXTRINSICS, INTRINSICS, Convention, StoredCamera
from ghgs_capture.crops import Photograph
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.photographs import Pixels, fits_stored
from ghgs_lit.data.mask_checks import find_equal_poses
from ghgs_lit.data.view import area_image, area_mask
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette, subject_sphere

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
PERSON = (0.5, 2.5)  #: A person's largest extent in metres
_UNITS = {"metres": 1.0, "millimetres": 0.001, "centimetres": 0.01, "kilometres": 1000.0}
# Least area, as a share of the largest part's, of a part of a mask that counts as another person
_PART = 1 / 3
# Copies of a photograph stored with losses: least overlap of their masks, and largest mean difference
# within them in levels of 255
_SAME_MASK = 0.98
_SAME_LEVELS = 2.0


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
class Hypothesis:
    """An interpretation of a calibration, and how well masks and cameras agree under it."""

    meaning: str
    option: str  #: command-line option for this interpretation; empty: none
    views: tuple[StoredView, ...]
    blames: tuple[str, ...] = ()  #: the cameras that it considers wrong; empty: all, or none
    #: share of each mask in the hull of the others; all 0 if no camera can have this interpretation
    shares: dict[str, float] = field(default_factory=dict)

    @property
    def score(self) -> float:
        """The agreement of the worst view."""
        return min(self.shares.values())

    def photographs(self, folder: CaptureFolder) -> list[Photograph]:
        """The downsampled photographs, upright and undistorted, with cameras of this interpretation.

        Args:
            folder: the folder that the views were read from.

        Raises:
            InputError: a photograph has another aspect ratio than its calibration.
        """
        return [
            folder.photograph(view.name, view.camera, view.pixels, view.mask * np.uint8(255), view.convention)
            for view in self.views
        ]

    def scored(self, folder: CaptureFolder) -> "Hypothesis":
        """Measure the :attr:`shares`.

        Args:
            folder: the folder that the views were read from.
        """
        try:
            shares = HullSearch().shares(_make_silhouettes(self.photographs(folder)))
        except (InputError, np.linalg.LinAlgError):
            shares = [0.0] * len(self.views)
        return replace(self, shares={v.name: share for v, share in zip(self.views, shares, strict=True)})


@dataclass(frozen=True)
class Diagnosis:
    """The report on a calibration."""

    consistent: bool
    lines: tuple[str, ...]
    best: Hypothesis  #: of all interpretations that were tried
    #: views that disagree with the others; possibly not empty if consistent
    suspects: tuple[str, ...] = ()


def diagnose(folder: CaptureFolder, instant: str | None = None) -> Diagnosis:
    """Examine the cameras of one instant.

    Tests for copies first, then other interpretations of all cameras, then mistakes of one or two cameras
    and cyclic exchanges of all.

    Args:
        folder: photographs, masks and calibration.
        instant: one of ``folder.instants``; None: the first.

    Returns:
        Whether cameras and masks agree, with the findings.

    Raises:
        InputError: a file cannot be read.
    """
    views = read_small_views(folder, folder.instants[0] if instant is None else instant)
    given = Hypothesis("the calibration is right as it is", "", views).scored(folder)
    same = find_equal_poses({view.name: view.camera.pose for view in views})
    if same is None and given.score > 0:
        same = find_copies(given.photographs(folder))
    if same is not None:
        line = f"{' and '.join(same)} have the same pose, or are the same photograph: one of them is a copy"
        return Diagnosis(False, (line,), given, same)
    if given.score >= AGREES:
        agree = f"{given.score:.0%} of each mask or more lies in the hull of the others"
        lines = [f"cameras and masks agree ({agree})", _describe_size(given, folder)]
        suspects, line = _find_suspects(given, folder) if given.score < _SOUND else ((), "")
        return Diagnosis(True, (*lines, line) if suspects else tuple(lines), given, suspects)
    tried = [given, *(hypothesis.scored(folder) for hypothesis in _reinterpret_all(views))]
    base = best = max(tried, key=lambda hypothesis: hypothesis.score)
    if best.score <= given.score + BETTER:
        base = given
    if best.score < AGREES:
        # A single wrong camera is sought under the best interpretation for all cameras.
        tried += [hypothesis.scored(folder) for hypothesis in _correct_some(base.views)]
        best = max(tried, key=lambda hypothesis: hypothesis.score)
    if best.score < max(AGREES, given.score + BETTER):
        suspects, line = _find_suspects(base, folder)
        return Diagnosis(False, (line,), best, suspects)
    line = f"{best.meaning}: masks agree by {best.score:.0%} instead of {given.score:.0%}"
    lines = [line, f"try {best.option}"] if best.option else [line]
    return Diagnosis(False, (*lines, _describe_size(best, folder)), best, best.blames)


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
        read = camera.sized(sizes[keeps_stored])
        small = Pixels(area_image(np.ascontiguousarray(pixels.image), *size), None, pixels.turns)
        mask = area_mask(np.ascontiguousarray(matte > 127), *size)
        turned = camera.sized(sizes[not keeps_stored])
        views.append(StoredView(name, read, small, mask, folder.convention, turned))
    return tuple(views)


def find_parted_masks(views: Sequence[StoredView]) -> list[str]:
    """Find masks that have a second large part, such as another person.

    Args:
        views: the photographs with their masks.

    Returns:
        The names of these photographs.
    """
    from scipy import ndimage  # imported here because the import is slow

    names = []
    for view in views:
        regions, _ = ndimage.label(view.mask)
        areas = np.sort(np.bincount(regions.ravel())[1:])
        if len(areas) > 1 and areas[-2] >= _PART * areas[-1]:
            names.append(view.name)
    return names


def find_copies(photographs: Sequence[Photograph]) -> tuple[str, str] | None:
    """Find two photographs that are copies of one picture, even if stored with losses.

    Args:
        photographs: photographs of one instant, with their mattes.

    Returns:
        Their names; None without copies.
    """
    for one, other in itertools.combinations(photographs, 2):
        if one.image.shape != other.image.shape:
            continue
        both = one.mask & other.mask
        either = one.mask | other.mask
        differences = np.abs(one.image.astype(np.int16) - other.image)[both]
        if both.sum() > _SAME_MASK * either.sum() and differences.mean() < _SAME_LEVELS:
            return one.name, other.name
    return None


def _make_silhouettes(photographs: Sequence[Photograph]) -> list[Silhouette]:
    return [Silhouette(p.mask, p.intrinsics, p.extrinsics) for p in photographs]


def _describe_size(hypothesis: Hypothesis, folder: CaptureFolder) -> str:
    """Describe the subject's largest extent in the user's unit, and the option that converts it to metres."""
    silhouettes = _make_silhouettes(hypothesis.photographs(folder))
    focus, _ = subject_sphere(silhouettes)
    size = float(np.median([silhouette.extent(focus).max() for silhouette in silhouettes]))
    for name, metres in _UNITS.items():
        if PERSON[0] <= size * metres <= PERSON[1]:
            option = f"calibration.unit={metres:g}"
            return f"the subject is {float(f'{size:.3g}'):g} units tall: a person in {name} ({option})"
    return f"the subject is {size:.3g} units tall; it is scaled to a person's size inside, and back"


def _find_suspects(hypothesis: Hypothesis, folder: CaptureFolder) -> tuple[tuple[str, ...], str]:
    """Views each of which explains most of the disagreement, and a line about it.

    A mask that lacks a part lies in the hull of the others but removes parts of them from their hulls, so
    the agreement of the others is compared with and without it."""
    least = max(AGREES, 1 - (1 - hypothesis.score) * _REST)
    fitting = {}
    for left_out in hypothesis.views if len(hypothesis.views) > 2 else ():
        rest = tuple(view for view in hypothesis.views if view is not left_out)
        score = replace(hypothesis, views=rest).scored(folder).score
        if score >= least:
            fitting[left_out.name] = score
    readings = {name: _describe_fault(hypothesis, name) for name in fitting}
    if len(hypothesis.views) == 3 and any(readings.values()):  # two views nearly always agree
        fitting = {name: score for name, score in fitting.items() if readings[name]}
    if not fitting:
        shares = ", ".join(f"{name} {share:.0%}" for name, share in hypothesis.shares.items())
        return (), f"masks and cameras disagree (share of each mask in the hull of the others: {shares})"
    best = max(fitting.values())
    names = tuple(name for name, score in fitting.items() if score >= best - _SAME)
    line = (
        f"{' or '.join(names)} disagrees with the others, which agree by {best:.0%} without it"
        f" and by {hypothesis.score:.0%} with it"
    )
    return names, line + (readings[names[0]] if len(names) == 1 else "")


def _describe_fault(hypothesis: Hypothesis, name: str) -> str:
    """Describe the likely fault of a view by whether its mask or another one lies outside its hull."""
    own = 1 - hypothesis.shares[name]
    others = 1 - min(share for other, share in hypothesis.shares.items() if other != name)
    if own <= _REST * others:
        return ": its mask lacks a part that theirs have, or its focal length is too long"
    if others <= _REST * own:
        return ": its mask has a part that theirs lack, or its focal length is too short"
    return ""


def _reinterpret_all(views: tuple[StoredView, ...]) -> Iterator[Hypothesis]:
    """Vary the direction of poses, axes, unit of the intrinsics, resize and EXIF rotation of all cameras."""
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
                changes.append(f"{key}={value if isinstance(value, str) else f'{value:.4g}'}")
        option = " ".join(f"calibration.{each}" for each in changes)
        yield Hypothesis(f"all cameras: {', '.join(changes)}", option, changed)


def _is_plausible(view: StoredView) -> bool:
    """Whether the principal point of a view lies in the central part (``_MIDDLE``) of its photograph."""
    share = view.camera.intrinsics[:2, 2] * view.convention.resized
    if view.convention.intrinsics == "pixels":
        share = share / np.array(view.camera.size)[::-1]
    return bool(((share >= _MIDDLE[0]) & (share <= _MIDDLE[1])).all())


def _correct_some(views: tuple[StoredView, ...]) -> Iterator[Hypothesis]:
    """Correct one camera, or exchange cameras or masks, which the hull cannot distinguish."""
    for i, view in enumerate(views):
        for mistake, changed in _correct_one(view):
            mended = (*views[:i], changed, *views[i + 1 :])
            yield Hypothesis(f"{view.name} alone: {mistake}", "", mended, (view.name,))
    orders = [views[1:] + views[:1], views[-1:] + views[:-1]] if len(views) > 2 else []
    for i, j in itertools.combinations(range(len(views)), 2):
        order = list(views)
        order[i], order[j] = views[j], views[i]
        orders.append(order)
    for order in orders:
        pairs = [(view, other) for view, other in zip(views, order, strict=True) if view is not other]
        names = ", ".join(f"{view.name}: {other.name}" for view, other in pairs)
        blames = tuple(view.name for view, _ in pairs)
        of_these = f"of {' and '.join(blames)} are exchanged"
        if _fit_better(pairs):
            changed = (replace(view, mask=other.mask) for view, other in zip(views, order, strict=True))
            yield Hypothesis(f"the masks {of_these}", "", tuple(changed), blames)
        else:
            changed = (replace(view, camera=other.camera) for view, other in zip(views, order, strict=True))
            yield Hypothesis(
                f"the cameras {of_these}", f"'calibration.names={{{names}}}'", tuple(changed), blames
            )


def _fit_better(pairs: Sequence[tuple[StoredView, StoredView]]) -> bool:
    """Whether the masks' outlines follow edges of the other photographs better than of their own."""
    if any(view.mask.shape != other.mask.shape for view, other in pairs):
        return False
    own = math.prod(_measure_contrast(view, view.mask) for view, _ in pairs)
    return math.prod(_measure_contrast(view, other.mask) for view, other in pairs) > own


def _measure_contrast(view: StoredView, mask: np.ndarray) -> float:
    """Mean gradient of the photograph along a mask's outline, which is largest for the right mask."""
    outline = np.hypot(*np.gradient(mask.astype(np.float64))) > 0
    gradient = np.hypot(*np.gradient(view.pixels.image.mean(-1)))
    return float(gradient[outline].mean()) if outline.any() else 0.0


def _correct_one(view: StoredView) -> Iterator[tuple[str, StoredView]]:
    """Describe usual mistakes of a single camera, each with the corrected view."""
    given = view.convention
    for extrinsics, axes in itertools.product(EXTRINSICS, AXES):
        convention = replace(given, extrinsics=extrinsics, axes=axes)
        if convention != given:
            yield f"its extrinsics are {extrinsics} with axes of {axes}", replace(view, convention=convention)
    camera = view.camera
    for factor, length in ((0.001, "long"), (1000.0, "short")):
        pose = camera.pose * [[1.0, 1.0, 1.0, factor]]
        pose[3] = camera.pose[3]
        yield f"its translation is 1000 times too {length}", replace(view, camera=replace(camera, pose=pose))
    middle = camera.intrinsics.copy()
    sides = np.array(camera.size)[::-1] if given.intrinsics == "pixels" else 1.0
    middle[:2, 2] = sides / 2 / given.resized
    lenses = {"its principal point should be near the middle": middle}
    for factor in (0.5, 2.0):
        mistake = f"its intrinsics are for photographs {1 / factor:g} times as large"
        lenses[mistake] = camera.intrinsics * [[factor], [factor], [1.0]]
    for mistake, intrinsics in lenses.items():
        yield mistake, replace(view, camera=replace(camera, intrinsics=intrinsics))
