"""Imperfections of captures: exposure and colour of single cameras, backgrounds, masks.

The count of random numbers that a function samples does not depend on its limits.
"""

import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.geometry.masks import signed_distance

# Stored colours are linear light to the power 1/2.2.
_GAMMA = 2.2
# Width of the bumps of a ragged outline in pixels.
_BUMP = 6
# Patches of backgrounds: number along a side, and maximum deviation of their colours.
_PATCHES = ((3, 0.35), (12, 0.15), (40, 0.06))
_NOISE = 0.02  # standard deviation of single pixels


def sample_color_gains(
    views: int, exposure: float, white_balance: float, rng: np.random.Generator
) -> Float[np.ndarray, "V 3"]:
    """Sample factors of stored colours with a geometric mean of 1 over cameras, as images show only
    differences between cameras.

    Args:
        views: number of cameras V.
        exposure: maximum deviation of a camera in stops, at least 0.
        white_balance: maximum deviation of red and of blue from green in stops, at least 0.

    Returns:
        Factors [V, 3] above 0.
    """
    deviation = rng.uniform(-1, 1, (views, 3))
    deviation -= deviation.mean(0)
    deviation /= np.maximum(1, np.abs(deviation).max(0))
    red, green, blue = (deviation * (white_balance, exposure, white_balance)).T
    return 2 ** (np.stack((green + red, green, green + blue), -1) / _GAMMA)


def perturb_mask(
    mask: Bool[np.ndarray, "h w"],
    offset: float,
    ragged: float,
    hole: float,
    hole_chance: float,
    rng: np.random.Generator,
) -> Bool[np.ndarray, "h w"]:
    """Add the errors of a segmentation to a mask; it stays unchanged if it would become empty.

    Args:
        mask: [h, w], true on the subject.
        offset: maximum growth or shrinkage in pixels, at least 0.
        ragged: maximum height of bumps of the outline in pixels, at least 0.
        hole: maximum diameter of a missing round piece, as a fraction of the subject's height.
        hole_chance: probability of a missing piece, in [0, 1].
    """
    grow, height, missing, size, place = rng.uniform(size=5)
    bumps = rng.uniform(-1, 1, [side // _BUMP + 2 for side in mask.shape])
    if not mask.any():
        return mask
    rows, columns = np.nonzero(mask)
    result = mask.copy()
    if offset or ragged:
        margin = math.ceil(offset + ragged) + 1
        window = tuple(
            slice(max(0, lines.min() - margin), lines.max() + 1 + margin) for lines in (rows, columns)
        )
        part = mask[window]
        sides = [_BUMP * side for side in bumps.shape]
        noise = _stretch(torch.from_numpy(bumps), *sides).numpy()
        noise = noise[: mask.shape[0], : mask.shape[1]][window]
        result[window] = signed_distance(part) + (2 * grow - 1) * offset + height * ragged * noise > 0
    if missing < hole_chance:
        middle = int(place * len(rows))
        radius = size * hole * (rows.max() - rows.min() + 1) / 2
        v, u = np.ogrid[: mask.shape[0], : mask.shape[1]]
        result &= (v - rows[middle]) ** 2 + (u - columns[middle]) ** 2 >= radius**2
    return result if result.any() else mask


def sample_backgrounds(
    views: int, height: int, width: int, rng: np.random.Generator
) -> Float[np.ndarray, "V 3 h w"]:
    """Sample a background for each camera: cloudy patterns of large and small patches.

    Args:
        views: number of cameras V.

    Returns:
        Colours [V, 3, h, w] float32 in [0, 1].
    """
    base = torch.from_numpy(0.5 + rng.uniform(-0.2, 0.2, (views, 3, 1, 1)))
    noise = torch.from_numpy(rng.standard_normal((views, 3, height, width)))
    colors = noise.float().mul_(_NOISE).add_(base.float())
    for cells, deviation in _PATCHES:
        patches = torch.from_numpy(rng.uniform(-deviation, deviation, (views, 3, cells, cells)))
        colors += _stretch(patches.float(), height, width)
    return colors.clamp_(0, 1).numpy()


def _stretch(patches: Float[Tensor, "*batch m n"], height: int, width: int) -> Float[Tensor, "*batch h w"]:
    """Interpolate patches bilinearly, with the centres of outer patches at the centres of outer pixels."""
    channels = patches.reshape(1, -1, *patches.shape[-2:])
    pixels = F.interpolate(channels, (height, width), mode="bilinear", align_corners=True)
    return pixels.reshape(*patches.shape[:-2], height, width)
