"""Other meanings of the numbers of a calibration (:class:`Hypothesis`), and how well masks agree
with them (:mod:`ghgs_lit.geometry.silhouettes`)."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from ghgs_capture.calibration import AXES, EXTRINSICS, INTRINSICS, Convention, StoredCamera
from ghgs_capture.crops import Photograph
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.photographs import Pixels
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette, subject_sphere

_MIDDLE = (0.3, 0.7)  # Shares of a photograph between which a principal point is plausible
# Usual factors of a resize after the calibration.
_RESIZES = (0.25, 1 / 3, 0.5, 2 / 3, 0.75, 1.0, 4 / 3, 1.5, 2.0, 3.0, 4.0)


@dataclass(frozen=True)
class StoredView:
    """One photograph at a small size, its camera as stored, and what the camera's numbers mean."""

    name: str
    camera: StoredCamera
    pixels: Pixels
    mask: np.ndarray
    convention: Convention
    turned: StoredCamera  #: the camera, where the photograph's EXIF turn is read the other way


@dataclass(frozen=True)
class Hypothesis:
    """A meaning of a calibration, and how well masks and cameras agree with it."""

    says: str
    option: str  #: of the command line, for this meaning; empty: none
    views: tuple[StoredView, ...]
    blames: tuple[str, ...] = ()  #: the cameras that are wrong by it; empty: all, or none
    #: of each mask, in the hull of the others
    shares: dict[str, float] = field(default_factory=dict)

    @property
    def score(self) -> float:
        """The agreement of the worst view."""
        return min(self.shares.values())

    def photographs(self, folder: CaptureFolder) -> list[Photograph]:
        """The small photographs without lens distortion, upright,
        with their cameras in this meaning.

        Args:
            folder: where the views come from; it knows how photographs are turned.

        Returns:
            A photograph for each view, with its mask as matte.

        Raises:
            InputError: a photograph has another aspect ratio than its calibration.
        """
        white = np.uint8(255)
        return [
            folder.photograph(v.name, v.camera, v.pixels, v.mask * white, v.convention) for v in self.views
        ]

    def silhouettes(self, folder: CaptureFolder) -> list[Silhouette]:
        """Masks with their cameras in this meaning.

        Args:
            folder: as for :meth:`photographs`.

        Returns:
            A silhouette for each view.

        Raises:
            InputError: a photograph has another aspect ratio than its calibration.
        """
        return [Silhouette(p.mask, p.intrinsics, p.extrinsics) for p in self.photographs(folder)]

    def ranked(self, folder: CaptureFolder) -> "Hypothesis":
        """Measure how well masks and cameras agree in this meaning.

        Args:
            folder: as for :meth:`photographs`.

        Returns:
            The same meaning with its :attr:`shares` from 0 to 1; all 0 where no camera can have it.
        """
        try:
            shares = HullSearch().shares(self.silhouettes(folder))
        except (InputError, np.linalg.LinAlgError):
            shares = [0.0] * len(self.views)
        return replace(self, shares={v.name: share for v, share in zip(self.views, shares, strict=True)})

    def size(self, folder: CaptureFolder) -> float:
        """Estimate the subject's largest extent.

        Args:
            folder: as for :meth:`photographs`.

        Returns:
            The median over views, in the user's unit; 0 where it is not known.
        """
        try:
            silhouettes = self.silhouettes(folder)
        except InputError:
            return 0.0
        focus, _ = subject_sphere(silhouettes)
        return float(np.median([s.extent(focus).max() for s in silhouettes]))


def for_turned(views: tuple[StoredView, ...]) -> Iterator[Hypothesis]:
    """The other reading of EXIF turns, where a photograph has one."""
    exif = "shown" if views[0].convention.exif == "stored" else "stored"
    if any(view.pixels.turns for view in views):
        convention = replace(views[0].convention, exif=exif)
        changed = tuple(replace(view, camera=view.turned, convention=convention) for view in views)
        yield Hypothesis(f"all cameras: exif {exif}", f"calibration.exif={exif}", changed)


def for_all(views: tuple[StoredView, ...]) -> Iterator[Hypothesis]:
    """Other meanings of all cameras: what poses map, axes, unit of the intrinsics, a resize, and
    EXIF turns."""
    given = views[0].convention
    readings = [views, *(hypothesis.views for hypothesis in for_turned(views))]
    points = [view.camera.intrinsics[:2, 2] / np.array(view.camera.size)[::-1] for view in views]
    scale = 0.5 / max(float(np.median(points)), 0.01)  # brings principal points to the middle
    likely = min(_RESIZES, key=lambda resize: abs(np.log(resize / scale)))
    for read, intrinsics, resized in itertools.product(readings, INTRINSICS, (given.resized, likely)):
        inner = replace(read[0].convention, intrinsics=intrinsics, resized=resized)
        if not all(_plausible(replace(view, convention=inner)) for view in read):
            continue
        for extrinsics, axes in itertools.product(EXTRINSICS, AXES):
            convention = replace(inner, extrinsics=extrinsics, axes=axes)
            if convention == given:
                continue
            changed = [
                (key, value if isinstance(value, str) else f"{value:.4g}")
                for key, value in vars(convention).items()
                if value != getattr(given, key)
            ]
            yield Hypothesis(
                f"all cameras: {', '.join(map(' '.join, changed))}",
                " ".join(f"calibration.{key}={value}" for key, value in changed),
                tuple(replace(view, convention=convention) for view in read),
            )


def _plausible(view: StoredView) -> bool:
    """Whether the principal point of a view lies in the middle part of its photograph
    (``_MIDDLE``)."""
    share = view.camera.intrinsics[:2, 2] * view.convention.resized
    if view.convention.intrinsics == "pixels":
        share = share / np.array(view.camera.size)[::-1]
    return bool(((share >= _MIDDLE[0]) & (share <= _MIDDLE[1])).all())


def for_some(views: tuple[StoredView, ...]) -> Iterator[Hypothesis]:
    """Mistakes of one camera, and two cameras or masks that are exchanged."""
    for i, view in enumerate(views):
        for says, changed in _mistakes(view):
            mended = (*views[:i], changed, *views[i + 1 :])
            yield Hypothesis(f"{view.name} alone: {says}", "", mended, (view.name,))
    names = [view.name for view in views]
    for step, word in ((1, "next"), (-1, "previous")) if len(views) > 2 else ():
        shifted = views[step:] + views[:step]
        changed = tuple(replace(v, camera=other.camera) for v, other in zip(views, shifted, strict=True))
        pairs = ", ".join(f"{v.name}: {other.name}" for v, other in zip(views, shifted, strict=True))
        says = f"each photograph has the camera of the {word} one"
        yield Hypothesis(says, f"'calibration.names={{{pairs}}}'", changed, tuple(names))
    for i, j in itertools.combinations(range(len(views)), 2):
        one = views[i]
        other = views[j]
        swapped = list(views)
        swapped[i] = replace(one, camera=other.camera)
        swapped[j] = replace(other, camera=one.camera)
        names = f"{one.name} and {other.name}"
        blames = (one.name, other.name)
        # Outlines of the masks may follow edges of the other photograph rather than of their own.
        if one.mask.shape == other.mask.shape and (
            _contrast(one, other.mask) * _contrast(other, one.mask)
            > _contrast(one, one.mask) * _contrast(other, other.mask)
        ):
            swapped[i] = replace(one, mask=other.mask)
            swapped[j] = replace(other, mask=one.mask)
            yield Hypothesis(f"the masks of {names} are exchanged", "", tuple(swapped), blames)
            continue
        option = f"'calibration.names={{{one.name}: {other.name}, {other.name}: {one.name}}}'"
        yield Hypothesis(f"the cameras of {names} are exchanged", option, tuple(swapped), blames)


def _mistakes(view: StoredView) -> Iterator[tuple[str, StoredView]]:
    """Usual mistakes of a single camera in words, each with the view after mending it."""
    given = view.convention
    for extrinsics, axes in itertools.product(EXTRINSICS, AXES):
        convention = replace(given, extrinsics=extrinsics, axes=axes)
        if convention != given:
            yield f"its extrinsics are {extrinsics} with axes of {axes}", replace(view, convention=convention)

    def with_camera(says: str, **changes: np.ndarray) -> tuple[str, StoredView]:
        return says, replace(view, camera=replace(view.camera, **changes))

    for factor, says in ((0.001, "long"), (1000.0, "short")):
        pose = view.camera.pose.copy()
        pose[:3, 3] *= factor
        yield with_camera(f"its translation is 1000 times too {says}", pose=pose)
    intrinsics = view.camera.intrinsics.copy()
    sides = np.array(view.camera.size)[::-1] if given.intrinsics == "pixels" else 1.0
    intrinsics[:2, 2] = sides / 2 / given.resized
    yield with_camera("its principal point should be near the middle", intrinsics=intrinsics)
    for factor in (0.5, 2.0):
        intrinsics = view.camera.intrinsics * [[factor], [factor], [1.0]]
        says = f"its intrinsics are for photographs {1 / factor:g} times as large"
        yield with_camera(says, intrinsics=intrinsics)


def _contrast(view: StoredView, mask: np.ndarray) -> float:
    """Mean gradient of the photograph on the outline of a mask, largest for the right mask."""
    on_outline = gradient_of(view.pixels.image)[outline_of(mask)]
    return float(on_outline.mean()) if len(on_outline) else 0.0


def gradient_of(image: np.ndarray) -> np.ndarray:
    return np.hypot(*np.gradient(image.astype(np.float64).mean(-1)))


def outline_of(mask: np.ndarray) -> np.ndarray:
    return np.hypot(*np.gradient(mask.astype(np.float64))) > 0
