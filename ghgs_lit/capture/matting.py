"""Mattes of photographs whose masks are a few pixels off, ragged or have holes.

A mask that is off by a pixel paints the background's colours on the subject's outline, other ones in every
view. The photograph itself says where the subject ends: a matte is sought that is a linear function of the
colours in every small window (Levin et al., A Closed-Form Solution to Natural Image Matting, CVPR 2006),
equal to the mask far from its outline, and drawn to it weakly near it. Then the colours of the subject alone
are estimated (Germer et al., Fast Multi-Level Foreground Estimation, ICPR 2020).
"""

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.linalg import cg

#: Of each pass: how far from the outline the matte is sought, as a share of ``pixels``, and the weight of
#: what it starts from beside the sum over windows of squared deviations. The first moves the outline, the
#: second makes it exact.
_PASSES = ((1.0, 0.03), (0.4, 0.1))
#: Variance of colours in a window that counts as noise.
_NOISE = 1e-5
#: Distance in pixels from the other side of an outline up to which a pixel can show both.
_RIM = 1.0
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
    from pymatting import estimate_foreground_ml  # here: it loads a compiler

    colors, found = image / 255.0, matte / 255.0
    for share, trust in _PASSES:
        inside = found > 0.5
        window = _window(inside, int(pixels) + 2)
        is_open = _to_other_side(inside[window]) <= share * pixels
        found[window] = _matte(colors[window], found[window], is_open, trust)
    premultiplied = estimate_foreground_ml(colors, found) * found[..., None]
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
    from pymatting import cf_laplacian

    if not is_open.any() or min(given.shape) < 3:  # smaller than a window
        return given
    laplacian = sparse.csr_array(cf_laplacian(colors, epsilon=_NOISE, is_known=~is_open.ravel()))
    rows, start = laplacian[is_open.ravel()], given[is_open]
    matrix = rows[:, is_open.ravel()] + trust * sparse.eye_array(len(start))
    right = trust * start - rows[:, ~is_open.ravel()] @ given[~is_open]
    by_diagonal = sparse.diags_array(1 / matrix.diagonal())
    found = given.copy()
    solution, _ = cg(matrix, right, x0=start, rtol=_RESIDUAL, maxiter=_STEPS, M=by_diagonal)
    found[is_open] = solution.clip(0, 1)
    return np.where(is_open, _with_thin_rim(found), found)


def _with_thin_rim(matte: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """The matte, 0 or 1 but at its outline: elsewhere there are traces of the mask and of textures."""
    inside = matte > 0.5
    return np.where(_to_other_side(inside) <= _RIM, matte, inside)
