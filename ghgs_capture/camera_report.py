"""Report on the cameras of a capture: other meanings of their numbers (:class:`Hypothesis`), ranked
by how well masks and cameras agree (:mod:`ghgs_lit.geometry.silhouettes`)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ghgs_capture.folder import CaptureFolder
from ghgs_capture.hypotheses import (
    Hypothesis,
    StoredView,
    for_all,
    for_some,
    for_turned,
    gradient_of,
    outline_of,
)
from ghgs_capture.photographs import Pixels, fits_stored
from ghgs_capture.placement import copies, placement_lines
from ghgs_lit.data.mask_checks import twins
from ghgs_lit.data.view import area_image, area_mask
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette, subject_sphere

#: Least agreement of every view of a right calibration, and by how much a better meaning must win.
AGREES = 0.9
BETTER = 0.05
#: Agreement below which a view is sought that disagrees,
#: and how much of the disagreement it may leave.
_SOUND = 0.97
_REST = 1 / 3
_SAME = 0.01  # Difference of agreement that tells nothing
_BESIDE = 3  # Pixels beside a mask in which it may lack a part
_SIDE = 320  # Longer side of the photographs that are compared, in pixels
PERSON = (0.5, 2.5)  #: A person's largest extent in metres
# A part of a mask is another person where it has this share of the largest part's area, or more.
_PART = 1 / 3
_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "metres": 1.0, "kilometres": 1000.0}


@dataclass(frozen=True)
class Diagnosis:
    """The report on a calibration."""

    consistent: bool
    lines: tuple[str, ...]
    option: str  #: of the command line, for the best meaning; empty: none
    ranking: tuple[Hypothesis, ...]  #: all meanings that were tried, the best first
    size: float  #: the subject's largest extent in the user's unit, by the best meaning
    #: views that disagree with the others; a few may also if consistent
    suspects: tuple[str, ...] = ()


def diagnose(folder: CaptureFolder, instant: str | None = None) -> Diagnosis:
    """Examine the cameras of one instant.

    Copies are looked for first, then other meanings of all cameras, then mistakes of one or two of
    them.

    Args:
        folder: photographs, masks and calibration.
        instant: one of ``folder.instants``; None: the first.

    Returns:
        Whether cameras and masks agree, with what was found and the meanings that were tried.

    Raises:
        InputError: a file cannot be read.
    """
    views = small_views(folder, folder.instants[0] if instant is None else instant)
    given = Hypothesis("the calibration is right as it is", "", views).ranked(folder)
    same = twins({view.name: view.camera.pose for view in views})
    if same is not None:
        line = f"{' and '.join(same)} have the same pose: one of them is a copy"
        return Diagnosis(False, (line,), "", (given,), given.size(folder), same)
    photographs = given.photographs(folder) if given.score > 0 else []
    same = copies(photographs)
    if same is not None:
        line = f"{' and '.join(same)} are the same photograph: one of them is a copy"
        return Diagnosis(False, (line,), "", (given,), given.size(folder), same)
    if given.score >= AGREES:
        size = given.size(folder)
        agree = f"{given.score:.0%} of each mask or more lies in the hull of the others"
        lines = [f"cameras and masks agree ({agree})", _size_line(size)]
        for other in (hypothesis.ranked(folder) for hypothesis in for_turned(views)):
            if other.score > given.score + _SAME:
                lines.append(f"{other.option} agrees better, by {other.score:.0%}")
        suspects, *suspicion = _suspected(given, folder) if given.score < _SOUND else ((),)
        lines += [*suspicion, *placement_lines(photographs, [view.camera.pose for view in views])]
        return Diagnosis(True, tuple(lines), "", (given,), size, suspects)
    tried = [given, *(hypothesis.ranked(folder) for hypothesis in for_all(views))]
    best = max(tried, key=lambda hypothesis: hypothesis.score)
    if best.score < AGREES:
        # A single wrong camera is sought with the best meaning for all.
        base = best if best.score > given.score + BETTER else given
        tried += [hypothesis.ranked(folder) for hypothesis in for_some(base.views)]
        best = max(tried, key=lambda hypothesis: hypothesis.score)
    tried.sort(key=lambda hypothesis: -hypothesis.score)
    if best.score >= max(AGREES, given.score + BETTER):
        size = best.size(folder)
        lines = [f"{best.says}: masks agree by {best.score:.0%} instead of {given.score:.0%}"]
        lines += [f"try {best.option}"] if best.option else []
        return Diagnosis(False, (*lines, _size_line(size)), best.option, tuple(tried), size, best.blames)
    return _unexplained(folder, given, tried)


def small_views(folder: CaptureFolder, instant: str) -> tuple[StoredView, ...]:
    """Decode the photographs of an instant, so small that many meanings can be tried.

    Args:
        folder: photographs, masks and calibration.
        instant: one of ``folder.instants``.

    Returns:
        A view for each photograph, of at most ``_SIDE`` pixels a side.

    Raises:
        InputError: a file cannot be read.
    """
    views = []
    for name, (camera, pixels, matte) in folder.decode(instant).items():
        height, width = pixels.size
        scale = min(_SIDE / max(height, width), 1)
        size = max(round(height * scale), 1), max(round(width * scale), 1)
        # Without a stored size the intrinsics are for the whole photograph.
        sizes = pixels.size, pixels.stored_size
        keeps_stored = fits_stored(pixels, camera, folder.convention.exif)
        read = camera.sized(sizes[keeps_stored])
        small = Pixels(area_image(np.ascontiguousarray(pixels.image), *size), None, pixels.turns)
        mask = area_mask(np.ascontiguousarray(matte > 127), *size)
        turned = camera.sized(sizes[not keeps_stored])
        views.append(StoredView(name, read, small, mask, folder.convention, turned))
    return tuple(views)


def in_parts(views: Sequence[StoredView]) -> list[str]:
    """Find masks that have a second large part, as two people have.

    Args:
        views: the photographs with their masks.

    Returns:
        The names of these photographs.
    """
    from scipy import ndimage  # here: it takes time to import

    names = []
    for view in views:
        regions, _ = ndimage.label(view.mask)
        areas = np.sort(np.bincount(regions.ravel())[1:])
        if len(areas) > 1 and areas[-2] >= _PART * areas[-1]:
            names.append(view.name)
    return names


def _size_line(size: float) -> str:
    if PERSON[0] <= size <= PERSON[1]:
        return f"the subject is {size:.3g} units tall: a person in metres"
    unit = next((n for n, u in _UNITS.items() if PERSON[0] <= size * u <= PERSON[1]), None)
    if unit is None:
        return f"the subject is {size:.3g} units tall; it is scaled to a person's size inside, and back"
    option = f"calibration.unit={_UNITS[unit]:g}"
    return f"the subject is {size:.4g} units tall, a person in {unit}: {option} makes it metres"


def _unexplained(folder: CaptureFolder, given: Hypothesis, tried: list[Hypothesis]) -> Diagnosis:
    """The diagnosis where no meaning fits: the view without which the others agree,
    if there is one."""
    base = max((h for h in tried if not h.blames), key=lambda h: h.score)
    base = base if base.score > given.score + BETTER else given
    suspects, *lines = _suspected(base, folder)
    shares = ", ".join(f"{name} {share:.0%}" for name, share in base.shares.items())
    if not suspects:
        lines = [f"masks and cameras disagree (share of each mask in the hull of the others: {shares})"]
    return Diagnosis(False, tuple(lines), "", tuple(tried), base.size(folder), suspects)


def _suspected(hypothesis: Hypothesis, folder: CaptureFolder) -> tuple[Any, ...]:
    """The views that explain by themselves most of the disagreement, and a line about them;
    () if none does.

    A mask that lacks a part lies in the hull of the others, and theirs do not lie in that with it:
    what is compared are the others with and without it."""
    least = max(AGREES, 1 - (1 - hypothesis.score) * _REST)
    without = {}
    for left_out in hypothesis.views if len(hypothesis.views) > 2 else ():
        rest = tuple(view for view in hypothesis.views if view is not left_out)
        without[left_out.name] = replace(hypothesis, views=rest).ranked(folder)
    fitting = {name: others.score for name, others in without.items() if others.score >= least}
    readings = {name: _reading(hypothesis, name) for name in fitting}
    if len(hypothesis.views) == 3 and any(readings.values()):  # two views alone agree nearly always
        fitting = {name: share for name, share in fitting.items() if readings[name]}
    if not fitting:
        return ((),)
    best = max(fitting.values())
    names = tuple(name for name, share in fitting.items() if share >= best - _SAME)
    line = f"{' or '.join(names)} disagrees with the others, which agree by {best:.0%} without it"
    if len(names) == 1:
        return names, f"{line} and by {hypothesis.score:.0%} with it{readings[names[0]]}"
    if len(names) == 2 and len(hypothesis.views) > 3:
        names = tuple(sorted(names, key=_edges(hypothesis, names, folder).__getitem__))
        return names, f"{line}: rather {names[0]}, by the edges of the photographs (silhouettes cannot tell)"
    return names, f"{line} (silhouettes cannot tell for sure)"


def _edges(hypothesis: Hypothesis, names: tuple[str, str], folder: CaptureFolder) -> dict[str, float]:
    """Contrast of two photographs, of which one's mask has a part that the other's lacks, at that
    part of the mask's outline, compared with the rest of it: the wrong mask's outline follows no
    edge there."""
    from scipy import ndimage  # here: it takes time to import

    photographs = hypothesis.photographs(folder)
    silhouettes = [Silhouette(p.mask, p.intrinsics, p.extrinsics) for p in photographs]
    more = min(names, key=hypothesis.shares.__getitem__)
    sphere = subject_sphere(silhouettes)
    edges = {}
    for place, view in enumerate(hypothesis.views):
        if view.name not in names:
            continue
        one = silhouettes[place]
        others = silhouettes[:place] + silhouettes[place + 1 :]
        close = ndimage.binary_dilation(one.mask, iterations=_BESIDE)
        around = ndimage.binary_dilation(one.mask, iterations=2 * _BESIDE)
        cells = np.argwhere(one.mask if view.name == more else around & ~close)
        meets = HullSearch().meets(one, cells[:, ::-1] + 0.5, others, *sphere)
        part = np.zeros_like(one.mask)
        part[tuple(cells[meets != (view.name == more)].T)] = True
        near = ndimage.binary_dilation(part, iterations=2 * _BESIDE)
        outline = outline_of(one.mask)
        gradient = gradient_of(photographs[place].image)
        here = gradient[outline & near]
        elsewhere = gradient[outline & ~near]
        edges[view.name] = (
            here.sum() / max(len(here), 1) / max(elsewhere.sum() / max(len(elsewhere), 1), 1e-6)
        )
    return edges


def _reading(hypothesis: Hypothesis, name: str) -> str:
    """What may be wrong with a view, by whether its own mask or those of the others lie
    outside a hull."""
    own = 1 - hypothesis.shares[name]
    others = 1 - min(share for other, share in hypothesis.shares.items() if other != name)
    if own <= _REST * others:
        return ": its mask lacks a part that theirs have, or its focal length is too long"
    if others <= _REST * own:
        return ": its mask has a part that theirs lack, or its focal length is too short"
    return ""
