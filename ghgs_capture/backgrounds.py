"""Estimate backgrounds of static cameras, and correct the masks of a sequence with them.

A static camera shows the same background in every instant, and at each pixel some instants show it without
the subject. Each mask is compared with the hull of the other masks (:mod:`ghgs_capture.agreement`); masks
that pass are kept. The others are segmented again from the difference to the background, from colours, and
from the hull of the other masks. Only large parts that change are applied; outlines are kept, since they are
refined with mattes."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from ghgs_capture.agreement import MISSED, Agreement, reach_of
from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph, shrink
from ghgs_capture.minimum_cut import NEIGHBOURS, minimum_cut, neighbour_pairs
from ghgs_lit.runtime.cores import allowed_cores

#: Instants, spread over a sequence, for its backgrounds; each pixel is free of the subject in several.
BACKGROUND_INSTANTS = 24
#: Approximate longer side of the subject, in pixels, at which masks are segmented: that of model inputs.
_SUBJECT = 256
_MIN_BACKGROUND = 6  #: Least number of photographs for a background
#: Largest difference between photographs of a background, in levels of 255.
_STEADY = 20.0
#: Least standard deviation of the noise in levels, and the number of deviations at which a pixel may
#: belong to either.
_NOISE = 2.0
_DEVIATIONS = 5.0
#: Least area of a large part, as a share of the mask's, and of a part that is no speck, as a share of the
#: largest part's.
_LARGE = 0.03
_SPECK = 0.05
_SHADED = (0.4, 1.0)  #: Range of the share of light that remains in a shadow
_BINS = 16  #: Bins of a histogram of colours along each channel
#: Correlation of brightness above which a part shows the background, which distinguishes a grey shirt
#: from a grey wall.
_ALIKE = 0.9
UNLIKE = -1.0  #: Mean log odds of colours below which a part is not of the subject
# Evidence of a pixel for the subject: least and most from the background; most from colours; from the
# given mask; from a position inside and outside of the others' hull, and outside of two of them.
_FROM_BACKGROUND = (-4.0, 6.0)
_FROM_COLORS = 3.0
_FROM_MASK = 1.0
_IN_HULL = 1.0
_OUT_OF_HULL = 2.0
_OUT_OF_TWO = 4.0
#: Cost of different labels of neighbours of one colour, and the share of it that remains at an edge
#: with a contrast of several times ``_CONTRAST`` levels.
_TOGETHER = 6.0
_AT_EDGE = 0.1
_CONTRAST = 10.0
_ROUNDS = 3  #: Masks corrected in one round define the hulls of the next


@dataclass(frozen=True)
class Background:
    """The background of one camera."""

    image: np.ndarray  #: [h, w, 3] float32, levels from 0 to 255
    known: np.ndarray  #: [h, w] bool
    odds: np.ndarray  #: [bins, bins, bins] log odds that a colour is of the subject

    @classmethod
    def of(
        cls, photographs: Sequence[Photograph], covered: Sequence[np.ndarray], trusted: Sequence[Photograph]
    ) -> "Background":
        """Estimate the background that photographs of one camera share.

        Each pixel is the mean over the quarter of the photographs (at least three) that agree best.

        Args:
            photographs: three or more of one camera, of one size.
            covered: [h, w] bool for each photograph, true where it may show the subject.
            trusted: photographs of the camera whose masks define the subject's colours.

        Returns:
            The background; ``known`` where enough photographs show it without the subject and differ
            by less than ``_STEADY`` levels.
        """
        images = np.stack([photograph.image for photograph in photographs])
        count = max(3, len(images) // 4)
        light = images.sum(-1, dtype=np.float32)
        for brightness, hidden in zip(light, covered, strict=True):
            brightness[hidden] = np.inf
        order = light.argsort(0)
        light = np.take_along_axis(light, order, 0)
        with np.errstate(invalid="ignore"):
            width = light[count - 1 :] - light[: len(light) - count + 1]
        width[~np.isfinite(width)] = np.inf
        chosen = np.take_along_axis(order, width.argmin(0) + np.arange(count)[:, None, None], 0)
        images = np.take_along_axis(images, chosen[..., None], 0)
        known = (np.ptp(images, axis=0).max(-1) < _STEADY) & np.isfinite(width.min(0))
        image = images.mean(0, dtype=np.float32)
        subject = [photograph.image[photograph.mask] for photograph in trusted]
        odds = _log_histogram(np.concatenate(subject)) - _log_histogram(image[known])
        return cls(image, known, odds.clip(-_FROM_COLORS, _FROM_COLORS))

    def mend(
        self, photograph: Photograph, inside: np.ndarray | None = None, most: np.ndarray | None = None
    ) -> Photograph:
        """Segment a photograph again.

        Args:
            photograph: photograph by this camera, with the background's size.
            inside: [h, w] distance in pixels of each pixel inside the hull of the other masks; None
                without other masks.
            most: as ``inside``, for the hull in which one of the other masks may be missed.

        Returns:
            The photograph with a corrected mask; the given one if no large part changes.
        """
        reach = reach_of(self.known.shape)
        there = photograph.mask if most is None else photograph.mask | (most > -reach)
        spans = [np.nonzero(there.any(axis))[0][[0, -1]] for axis in (1, 0)]
        margin = (24 if most is None else 8) * reach  # without hulls, missing parts are sought near the mask
        box = tuple(slice(max(first - margin, 0), last + margin) for first, last in spans)
        evidence = self._evidence(photograph, box)
        hull = None
        if inside is not None:
            hull = inside[box]
            outside = np.where(hull < -reach, -_OUT_OF_HULL, 0)
            evidence += np.where(hull > 0, _IN_HULL, outside)
            evidence -= np.where(most[box] < -reach, _OUT_OF_TWO, 0)
        costs = self._costs(photograph, box)
        cut = minimum_cut(evidence, costs)
        changed = self._change_matte(photograph, cut, box, hull)
        if changed is None:
            return photograph
        matte = photograph.matte.copy()
        matte[box] = changed
        return replace(photograph, matte=matte)

    def _evidence(self, photograph: Photograph, box: tuple[slice, slice]) -> np.ndarray:
        """Evidence of background, colours and mask for each pixel of a box; positive for the subject."""
        image, behind, known = photograph.image[box], self.image[box], self.known[box]
        mask = photograph.mask[box]
        off = np.abs(image - behind).max(-1)
        light = (image * behind).sum(-1) / np.square(behind).sum(-1).clip(1)
        is_shaded = (light > _SHADED[0]) & (light < _SHADED[1])
        off = np.where(is_shaded, np.abs(image - light[..., None] * behind).max(-1), off)
        outside = off[known & ~mask]
        noise = max(1.4826 * float(np.median(outside)), _NOISE) if len(outside) else np.inf
        away = ndimage.uniform_filter(off, 3) / (_DEVIATIONS / 2 * noise)
        seen = (away**2 / 2 - 2).clip(*_FROM_BACKGROUND)
        colors = self.odds_of(image)
        evidence = np.where(known, seen + colors / 2, colors)
        return evidence + np.where(mask, _FROM_MASK, -_FROM_MASK)

    def odds_of(self, image: np.ndarray) -> np.ndarray:
        """Look up :attr:`odds` for the colours of pixels [..., 3] uint8."""
        return self.odds[tuple(np.moveaxis(image // (256 // _BINS), -1, 0))]

    def _costs(self, photograph: Photograph, box: tuple[slice, slice]) -> list[np.ndarray]:
        """Costs of pairs of neighbours, lower at edges of the photograph that the background lacks."""
        image, behind, known = photograph.image[box], self.image[box], self.known[box]
        costs = []
        for step in NEIGHBOURS:
            first, second = neighbour_pairs(image.astype(np.float32), step)
            contrast = np.abs(first - second).max(-1)
            first, second = neighbour_pairs(behind, step)
            are_known = np.logical_and(*neighbour_pairs(known, step))
            contrast = (contrast - np.abs(first - second).max(-1) * are_known).clip(0)
            alike = np.exp(-np.square(contrast / _CONTRAST) / 2)
            costs.append(_TOGETHER * (_AT_EDGE + (1 - _AT_EDGE) * alike) / np.hypot(*step))
        return costs

    def _change_matte(
        self, photograph: Photograph, cut: np.ndarray, box: tuple[slice, slice], hull: np.ndarray | None
    ) -> np.ndarray | None:
        """The matte [h, w] uint8 of a box with the large changes of the mask ``cut``; None without any."""
        image, behind, known = photograph.image[box], self.image[box], self.known[box]
        matte = photograph.matte[box]
        mask = matte > 127
        reach = reach_of(self.known.shape)
        far = np.zeros_like(mask) if hull is None else hull < -reach

        def is_background(part: np.ndarray) -> bool:
            shows_it = _is_alike(image[part], behind[part]) or self.odds_of(image[part]).mean() < UNLIKE
            return far[part].mean() > 0.5 or (known[part].mean() > 0.5 and shows_it)

        gone = _parts(_large(mask & ~cut, mask, reach), is_background)
        come = _large(cut & ~mask, mask, reach)
        if not gone.any() and not come.any():
            return None
        # Parts that change include their rims, which the opening removed.
        gone = ndimage.binary_dilation(gone, iterations=reach, mask=mask & ~cut)
        come = ndimage.binary_dilation(come, iterations=reach, mask=cut & ~mask)
        matte = np.where(come, np.uint8(255), np.where(gone, np.uint8(0), matte))
        if come.any():  # closes the seam between parts
            closed = ndimage.binary_closing(np.pad(matte > 127, 3), iterations=3)[3:-3, 3:-3]
            matte = np.maximum(matte, (closed & cut) * np.uint8(255))
        return _without_specks(matte)


def _without_specks(matte: np.ndarray) -> np.ndarray:
    """Remove parts of a matte [h, w] uint8 that are much smaller than the largest."""
    labels, count = ndimage.label(matte > 127)
    areas = np.bincount(labels.ravel(), minlength=count + 1)
    areas[0] = areas[1:].max(initial=0)
    return np.where((areas < _SPECK * areas[0])[labels], np.uint8(0), matte)


def _log_histogram(colors: np.ndarray) -> np.ndarray:
    """Log of the share of colours [n, 3] in each bin, smoothed so that none is 0."""
    bins = (colors.clip(0, 255) // (256 // _BINS)).astype(int)
    counts = np.bincount(np.ravel_multi_index(bins.T, (_BINS,) * 3), minlength=_BINS**3)
    smooth = ndimage.gaussian_filter(counts.reshape((_BINS,) * 3).astype(np.float64), 0.7)
    return np.log(smooth / max(smooth.sum(), 1) + 1e-3 / _BINS**3)


def _is_alike(image: np.ndarray, behind: np.ndarray) -> bool:
    """Whether pixels [n, 3] have the pattern of the background."""
    light = np.stack((image, behind)).astype(np.float64).sum(-1)
    light -= light.mean(1, keepdims=True)
    return (light[0] * light[1]).sum() > _ALIKE * np.sqrt(np.square(light).sum(1).prod())


def _parts(parts: np.ndarray, keep: Callable[[np.ndarray], bool]) -> np.ndarray:
    """Select the connected parts for which ``keep``, called with the mask of one part, returns true."""
    labels, count = ndimage.label(parts)
    return np.isin(labels, [number for number in range(1, count + 1) if keep(labels == number)])


def _large(parts: np.ndarray, mask: np.ndarray, reach: int) -> np.ndarray:
    """Select parts that survive an opening and cover at least the share ``_LARGE`` of the mask's area."""
    labels, count = ndimage.label(ndimage.binary_opening(parts, iterations=reach))
    areas = np.bincount(labels.ravel(), minlength=count + 1)
    areas[0] = 0
    return (areas >= max(_LARGE * mask.sum(), 1))[labels]


@dataclass(frozen=True)
class Backgrounds:
    """The backgrounds of a static rig, by camera."""

    cameras: Mapping[str, Background]
    #: Pixels of a photograph along the side of one pixel of the background, by camera
    factors: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of(cls, captures: Sequence[Capture]) -> "Backgrounds":
        """Estimate backgrounds from instants that are spread over a sequence.

        Args:
            captures: the instants, of static cameras.

        Returns:
            The backgrounds of cameras with at least ``_MIN_BACKGROUND`` photographs, all of one size.
        """
        extents: dict[str, list[int]] = {}
        for photograph in itertools.chain.from_iterable(capture.photographs for capture in captures):
            longest = max(end - first for first, end in photograph.extents)
            extents.setdefault(photograph.name, []).append(longest)
        factors = {name: max(round(max(each) / _SUBJECT), 1) for name, each in extents.items()}
        backgrounds = cls({}, factors)
        photographs: dict[str, list[Photograph]] = {}
        trusted: dict[str, list[Photograph]] = {}
        covered: dict[str, list[np.ndarray]] = {}
        for capture in map(backgrounds._small, captures):
            agreement = Agreement.of(capture)
            for view, photograph in enumerate(capture.photographs):
                photographs.setdefault(photograph.name, []).append(photograph)
                covered.setdefault(photograph.name, []).append(_find_covered(photograph, view, agreement))
                if agreement is None or not agreement.failed[view]:
                    trusted.setdefault(photograph.name, []).append(photograph)
        cameras = {}
        for name, of_camera in photographs.items():
            shapes = {photograph.mask.shape for photograph in of_camera}
            if len(of_camera) >= _MIN_BACKGROUND and len(shapes) == 1:
                cameras[name] = Background.of(of_camera, covered[name], trusted.get(name, of_camera))
        return cls(cameras, factors)

    def apply(self, capture: Capture) -> Capture:
        """Correct the masks that fail, if all masks agree better afterwards.

        Args:
            capture: an instant; cameras without a background of their photograph's size keep their
                masks.

        Returns:
            The capture with corrected masks; photographs with right masks are returned unchanged.
        """
        if not self.cameras:
            return capture
        given = small = self._small(capture)
        agreement = Agreement.of(small)
        for _ in range(_ROUNDS if agreement else 1):
            mended = self._mend(small, agreement)
            if all(a is b for a, b in zip(mended.photographs, small.photographs, strict=True)):
                break
            after = Agreement.of(mended)
            if agreement and sum(after.misses) >= sum(agreement.misses):
                break
            small = mended
            agreement = after
        photographs = map(self._take_over, capture.photographs, given.photographs, small.photographs)
        return replace(capture, photographs=tuple(photographs))

    def _small(self, capture: Capture) -> Capture:
        photographs = (shrink(photo, self.factors.get(photo.name, 1)) for photo in capture.photographs)
        return replace(capture, photographs=tuple(photographs))

    def _mend(self, capture: Capture, agreement: Agreement | None) -> Capture:
        """Correct the failed masks of an instant once."""

        def mend(view: int) -> Photograph:
            photograph = capture.photographs[view]
            background = self.cameras.get(photograph.name)
            fits = background is not None and background.known.shape == photograph.mask.shape
            if not fits or (agreement and not agreement.failed[view]):
                return photograph
            if agreement is None:
                return background.mend(photograph)
            hulls = (agreement.depth_in_others(view, spare=spare) for spare in (0, 1))
            return background.mend(photograph, *hulls)

        with ThreadPoolExecutor(allowed_cores()) as pool:
            return replace(capture, photographs=tuple(pool.map(mend, range(len(capture.photographs)))))

    def _take_over(self, photograph: Photograph, given: Photograph, mended: Photograph) -> Photograph:
        """Apply the changes of a downsampled mask to its photograph."""
        if mended is given:
            return photograph
        factor = self.factors[photograph.name]
        changed = mended.matte != given.matte
        changed, small = (each.repeat(factor, 0).repeat(factor, 1) for each in (changed, mended.matte))
        matte = photograph.matte.copy()
        whole = tuple(map(slice, changed.shape))
        matte[whole] = np.where(changed, small, matte[whole])
        return replace(photograph, matte=_without_specks(matte))


def _find_covered(photograph: Photograph, view: int, agreement: Agreement | None) -> np.ndarray:
    """Pixels [h, w] that may show the subject, including parts that its mask lacks."""
    reach = reach_of(photograph.mask.shape)
    covered = ndimage.binary_dilation(photograph.mask, iterations=reach)
    if agreement is not None and agreement.takes[view] > MISSED:
        covered |= agreement.depth_in_others(view) > -reach
    return covered
