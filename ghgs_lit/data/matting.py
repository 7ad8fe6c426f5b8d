"""Mattes of photographs whose masks are a few pixels off, ragged or have holes.

A mask that is off by a pixel paints the background's colours on the subject's outline, other ones in every
view. The photograph itself says where the subject ends: a matte is sought that is a linear function of the
colours in every small window (Levin et al., A Closed-Form Solution to Natural Image Matting, CVPR 2006),
equal to the mask far from its outline, and drawn to it weakly near it. Then the colours of the subject alone
are estimated from those on both sides.
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy.lib.stride_tricks import sliding_window_view
from scipy import sparse
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.sparse.linalg import cg

#: Of each pass: how far from the outline the matte is sought, as a share of ``pixels``, and the weight of
#: what it starts from beside the sum over windows of squared deviations. The first moves the outline, the
#: second makes it exact.
_PASSES = ((1.0, 0.03), (0.4, 0.1))
#: Side of the windows in pixels, and sum of squared deviations of colours in them that counts as noise.
_SIDE, _NOISE = 3, 1e-5
#: Distance in pixels from the other side of an outline up to which a pixel can show both.
_RIM = 1.0
#: Pixels from which a side's colour comes (standard deviation).
_NEAR = 1.0
#: Least residual of the equations, as a share of their right side, and most steps towards it.
_RESIDUAL, _STEPS = 1e-5, 1000


def refined_matte(
    image: UInt8[np.ndarray, "h w 3"], matte: UInt8[np.ndarray, "h w"], pixels: float
) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """The subject on black (premultiplied), and its matte.

    Args:
        image: the photograph, with its background.
        matte: 255 times the share of each pixel that shows the subject, a mask's 0 and 255 for instance.
        pixels: by how much the outline may be wrong, above 0; holes of twice that width are filled, too,
            where the photograph shows no edge around them.
    """
    colors, found = image / 255.0, matte / 255.0
    for share, trust in _PASSES:
        inside = found > 0.5
        window = _window(inside, int(pixels) + 2)
        is_open = _to_other_side(inside[window]) <= share * pixels
        found[window] = _matte(colors[window], found[window], is_open, trust)
    premultiplied = _subject_colors(colors, found) * found[..., None]
    return tuple(np.round(255 * part.clip(0, 1)).astype(np.uint8) for part in (premultiplied, found))


def _window(inside: Bool[np.ndarray, "h w"], margin: int) -> tuple[slice, slice]:
    """The part of an image around its mask; all of it where the mask is empty."""
    lines = (np.nonzero(inside.any(axis))[0] for axis in (1, 0))
    return tuple(slice(max(n[0] - margin, 0), n[-1] + margin + 1) if len(n) else slice(None) for n in lines)


def _to_other_side(inside: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Distance in pixels to the nearest pixel on the other side of the outline; infinite without one.

    The image's border is no outline.
    """
    if inside.all() or not inside.any():
        return np.full(inside.shape, np.inf)
    return np.where(inside, distance_transform_edt(inside), distance_transform_edt(~inside))


def _matte(
    colors: Float[np.ndarray, "h w 3"],
    given: Float[np.ndarray, "h w"],
    is_open: Bool[np.ndarray, "h w"],
    trust: float,
) -> Float[np.ndarray, "h w"]:
    """The matte where it is sought, ``given`` elsewhere."""
    if not is_open.any() or min(given.shape) < _SIDE:
        return given
    rows, start = _laplacian(colors, is_open)[is_open.ravel()], given[is_open]
    matrix = rows[:, is_open.ravel()] + trust * sparse.eye_array(len(start))
    right = trust * start - rows[:, ~is_open.ravel()] @ given[~is_open]
    by_diagonal = sparse.diags_array(1 / matrix.diagonal())
    found = given.copy()
    solution, _ = cg(matrix, right, x0=start, rtol=_RESIDUAL, maxiter=_STEPS, M=by_diagonal)
    found[is_open] = solution.clip(0, 1)
    return np.where(is_open, _with_thin_rim(found), found)


def _laplacian(colors: Float[np.ndarray, "h w 3"], is_open: Bool[np.ndarray, "h w"]) -> sparse.csr_array:
    """The matting Laplacian [h w, h w] of the windows with open pixels (Levin et al., Eq. 12)."""
    count = _SIDE**2
    windows = sliding_window_view(np.arange(is_open.size).reshape(is_open.shape), (_SIDE, _SIDE))
    windows = windows.reshape(-1, count)
    windows = windows[is_open.ravel()[windows].any(1)]
    inside = colors.reshape(-1, 3)[windows]
    deviation = inside - inside.mean(1, keepdims=True)
    covariance = deviation.mT @ deviation + _NOISE * np.eye(3)
    entries = np.eye(count) - 1 / count - deviation @ np.linalg.solve(covariance, deviation.mT)
    places = (np.repeat(windows, count, 1).ravel(), np.tile(windows, count).ravel())
    return sparse.coo_array((entries.ravel(), places), shape=(is_open.size,) * 2).tocsr()


def _subject_colors(
    colors: Float[np.ndarray, "h w 3"], matte: Float[np.ndarray, "h w"]
) -> Float[np.ndarray, "h w 3"]:
    """The colours whose mixtures with the background's the photograph shows; as they are inside.

    They are the nearest ones, in the sense of least squares, to those on both sides of the outline.
    """
    share = matte[..., None]
    subject, behind = (_near(colors, side) for side in (matte == 1, matte == 0))
    left = colors - share * subject - (1 - share) * behind
    mixed = subject + share * left / (share**2 + (1 - share) ** 2)
    return np.where((share > 0) & (share < 1), mixed, colors)


def _near(colors: Float[np.ndarray, "h w 3"], where: Bool[np.ndarray, "h w"]) -> Float[np.ndarray, "h w 3"]:
    """Means of the colours near each pixel, of the pixels ``where``; without such, the pixel's own."""
    weight = gaussian_filter(where.astype(float), _NEAR)[..., None]
    sums = gaussian_filter(colors * where[..., None], (_NEAR, _NEAR, 0))
    return np.where(weight > 1e-6, sums / np.where(weight > 1e-6, weight, 1), colors)


def _with_thin_rim(matte: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The matte, 0 or 1 but at its outline: elsewhere there are traces of the mask and of textures."""
    inside = matte > 0.5
    return np.where(_to_other_side(inside) <= _RIM, matte, inside)
