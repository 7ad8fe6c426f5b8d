"""Backgrounds of cameras that stand still, and masks corrected by them.

Such a camera shows the same background in every instant, and at each pixel some instants show it without the
subject. Large parts of a mask that show the background are removed, large parts beside it that do not are
added. Outlines stay as they are: finding them is the work of mattes."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from ghgs_capture.capture import Capture
from ghgs_capture.crops import Photograph
from ghgs_lit.runtime.cores import allowed_cores

_MIN_BACKGROUND = 6  #: Least number of photographs for a background
#: Levels of 255 by which photographs of a background differ at most, and the subject at least.
_STEADY = 20.0
_DIFFERENT = 12.0
_DEVIATIONS = 4.0  #: Deviations of the noise beyond which a pixel differs
#: Shares of area: of the mask, for a large part; of the largest part, below which one is a speck.
_LARGE = 0.03
_SPECK = 0.05
_DARK = 0.3  #: Least share of the light that a shadow leaves
#: Correlation of brightness above which a part shows the background: a grey shirt is no grey wall.
_ALIKE = 0.9


@dataclass(frozen=True)
class _Background:
    """The background of one camera: ``image`` [h, w, 3] float32 where it is ``known`` [h, w]."""

    image: np.ndarray
    known: np.ndarray

    @classmethod
    def of(cls, photographs: Sequence[Photograph]) -> "_Background":
        """The background that photographs of one camera share.

        At each pixel it is the mean of a quarter of them (at least three), those that agree best.

        Args:
            photographs: three or more of one camera, of one size.

        Returns:
            The background; known where enough photographs show it without the subject and differ by
            less than ``_STEADY`` levels.
        """
        images = np.stack([photograph.image for photograph in photographs]).astype(np.float32)
        count = max(3, len(images) // 4)
        reach = _reach(images.shape[1:3])
        light = images.sum(-1)
        for brightness, photograph in zip(light, photographs, strict=True):
            brightness[ndimage.binary_dilation(photograph.mask, iterations=reach)] = np.inf
        order = light.argsort(0)
        light = np.take_along_axis(light, order, 0)
        with np.errstate(invalid="ignore"):
            width = light[count - 1 :] - light[: len(light) - count + 1]
        width[~np.isfinite(width)] = np.inf
        chosen = np.take_along_axis(order, width.argmin(0) + np.arange(count)[:, None, None], 0)
        images = np.take_along_axis(images, chosen[..., None], 0)
        steady = np.ptp(images, axis=0).max(-1) < _STEADY
        return cls(images.mean(0), steady & np.isfinite(width.min(0)))

    def mended(self, photograph: Photograph) -> Photograph:
        """Correct the mask of a photograph by this background.

        Args:
            photograph: of this camera, of the background's size.

        Returns:
            The photograph with a corrected mask; itself where the background does not contradict
            it.
        """
        reach = _reach(self.known.shape)
        box = tuple(slice(max(a - 24 * reach, 0), b + 24 * reach) for a, b in photograph.extents)
        seen = (photograph.image, photograph.matte, self.image, self.known)
        mended_part = _mended(*(pixels[box] for pixels in seen), reach)
        if mended_part is None:
            return photograph
        matte = photograph.matte.copy()
        matte[box] = mended_part
        return replace(photograph, matte=matte)


def _mended(
    image: np.ndarray, matte: np.ndarray, behind: np.ndarray, known: np.ndarray, reach: int
) -> np.ndarray | None:
    """Correct the matte of a photograph in front of a background.

    Args:
        image: the photograph [h, w, 3] uint8.
        matte: its matte [h, w] uint8; above 127 is the subject.
        behind: the background [h, w, 3] float32, levels from 0 to 255.
        known: where the background is known [h, w] bool.
        reach: pixels by which outlines of masks may be wrong.

    Returns:
        The corrected matte [h, w] uint8; None: it stays as it is.
    """
    mask = matte > 127
    off = ndimage.uniform_filter(np.abs(image - behind).max(-1) * known, 3)
    outside = off[known & ~mask]
    least = max(_DEVIATIONS * 1.4826 * float(np.median(outside)), _DIFFERENT) if len(outside) else np.inf
    same = known & (ndimage.uniform_filter(off, 7) < 0.7 * least)
    gone = _parts(_large(mask & same, mask, reach), lambda part: _is_alike(image[part], behind[part]))
    gone = ndimage.binary_dilation(gone, iterations=reach, mask=mask & (off < 2 * least))
    come = _large(known & (off > 2 * least) & ~mask, mask, reach)
    come = _parts(come, lambda part: not _is_shaded(image[part], behind[part]))
    if not gone.any() and not come.any():
        return None
    matte = np.where(come, np.uint8(255), np.where(gone, np.uint8(0), matte))
    if come.any():  # fills the rim, which differs less clearly
        matte = np.maximum(matte, ndimage.binary_closing(matte > 127, iterations=3) * np.uint8(255))
    labels, count = ndimage.label(matte > 127)
    areas = np.bincount(labels.ravel(), minlength=count + 1)
    areas[0] = areas[1:].max(initial=0)
    return np.where((areas < _SPECK * areas[0])[labels], np.uint8(0), matte)


def _is_shaded(image: np.ndarray, behind: np.ndarray) -> bool:
    """Whether a shadow on the background explains most pixels [n, 3]."""
    light = (image * behind).sum(-1) / np.square(behind).sum(-1).clip(1)
    missed = np.abs(image - light[:, None] * behind).max(-1)
    return ((light > _DARK) & (light < 1) & (missed < _DIFFERENT)).mean() > 0.5


def _is_alike(image: np.ndarray, behind: np.ndarray) -> bool:
    """Whether pixels [n, 3] have the pattern of the background."""
    light = np.stack((image, behind)).astype(np.float64).sum(-1)
    light -= light.mean(1, keepdims=True)
    return (light[0] * light[1]).sum() > _ALIKE * np.sqrt(np.square(light).sum(1).prod())


def _parts(parts: np.ndarray, keep: Callable[[np.ndarray], bool]) -> np.ndarray:
    """The connected parts for which ``keep``, called with the mask of one part, says true."""
    labels, count = ndimage.label(parts)
    return np.isin(labels, [number for number in range(1, count + 1) if keep(labels == number)])


def _reach(size: tuple[int, int]) -> int:
    """Pixels by which outlines of masks may be wrong."""
    return max(max(size) // 200, 2)


def _large(parts: np.ndarray, mask: np.ndarray, reach: int) -> np.ndarray:
    """The parts that are thick and have ``_LARGE`` of the mask's area."""
    labels, count = ndimage.label(ndimage.binary_opening(parts, iterations=reach))
    areas = np.bincount(labels.ravel(), minlength=count + 1)
    areas[0] = 0
    return (areas >= max(_LARGE * mask.sum(), 1))[labels]


@dataclass(frozen=True)
class Backgrounds:
    """The backgrounds of a rig that stands still, by camera."""

    cameras: Mapping[str, _Background]

    @classmethod
    def of(cls, captures: Sequence[Capture]) -> "Backgrounds":
        """Estimate backgrounds from instants that are spread over a sequence.

        Args:
            captures: the instants, of cameras that stand still.

        Returns:
            The backgrounds of cameras with ``_MIN_BACKGROUND`` photographs or more, all of one size.
        """
        photographs: dict[str, list[Photograph]] = {}
        for photograph in (photograph for capture in captures for photograph in capture.photographs):
            photographs.setdefault(photograph.name, []).append(photograph)
        cameras = {}
        for name, of_camera in photographs.items():
            shapes = {photograph.mask.shape for photograph in of_camera}
            if len(of_camera) >= _MIN_BACKGROUND and len(shapes) == 1:
                cameras[name] = _Background.of(of_camera)
        return cls(cameras)

    def applied(self, capture: Capture) -> Capture:
        """Correct masks where large parts of them contradict the background.

        Args:
            capture: an instant; cameras without a background of their photograph's size keep their
                masks.

        Returns:
            The capture with corrected masks.
        """
        with ThreadPoolExecutor(allowed_cores()) as pool:
            return replace(capture, photographs=tuple(pool.map(self._mended, capture.photographs)))

    def _mended(self, photograph: Photograph) -> Photograph:
        background = self.cameras.get(photograph.name)
        fits = background is not None and background.known.shape == photograph.mask.shape
        return background.mended(photograph) if fits else photograph
