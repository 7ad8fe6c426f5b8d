"""FLIP, a perceptual image difference without trained weights.

P. Andersson, J. Nilsson, T. Akenine-Möller, M. Oskarsson, K. Åström, M. D. Fairchild, "FLIP: A
Difference Evaluator for Alternating Images", HPG 2020. Section numbers below are that paper's.
Images are sRGB in [0, 1]; the result lies in [0, 1], 0 for equal images."""

import itertools
import math

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.metrics.functional import correlate

PIXELS_PER_DEGREE = 67.0206
"""Resolution seen by the paper's viewer, 0.7 m from a screen that is 0.7 m and 3840 pixels wide."""

# Contrast sensitivity as sums of Gaussians (table 1):
# amplitude and width for each opponent channel.
_SENSITIVITY = {"Y": ((1.0, 0.0047),), "Cx": ((1.0, 0.0053),), "Cz": ((34.1, 0.04), (13.5, 0.025))}
_COLOR_EXPONENT, _FEATURE_EXPONENT = 0.7, 0.5
_KNEE, _KNEE_VALUE = 0.4, 0.95  # p_c and p_t of section 4.1.4
_FEATURE_WIDTH = 0.082  # degrees, section 4.2
# Linear RGB to CIE XYZ under D65, exact fractions of the sRGB primaries.
_RGB_TO_XYZ = (
    (10135552 / 24577794, 8788810 / 24577794, 4435075 / 24577794),
    (2613072 / 12288897, 8788810 / 12288897, 887015 / 12288897),
    (1425312 / 73733382, 8788810 / 73733382, 70074185 / 73733382),
)


def _transform_colors(image: Tensor, matrix: Tensor) -> Tensor:
    return torch.einsum("ij,njhw->nihw", matrix, image)


def _xyz_matrices(like: Tensor) -> tuple[Tensor, Tensor]:
    """Matrix to XYZ relative to the white point, and its inverse."""
    matrix = torch.tensor(_RGB_TO_XYZ, dtype=torch.float64)
    relative = matrix / matrix.sum(1, keepdim=True)
    return relative.to(like), torch.linalg.inv(relative).to(like)


def _linear_rgb(image: Tensor) -> Tensor:
    steep = ((image.clamp(min=0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(image > 0.04045, steep, image / 12.92)


def _opponent(xyz: Tensor) -> Tensor:
    """Convert XYZ relative to white to YCxCz (a linear CIELab)."""
    x, y, z = xyz.split(1, dim=1)
    return torch.cat((116 * y - 16, 500 * (x - y), 200 * (y - z)), dim=1)


def _from_opponent(ycc: Tensor) -> Tensor:
    y = (ycc[:, :1] + 16) / 116
    return torch.cat((y + ycc[:, 1:2] / 500, y, y - ycc[:, 2:] / 200), dim=1)


def _hunt_lab(xyz: Tensor) -> Tensor:
    """Convert XYZ relative to white to CIELab with chroma scaled by lightness (Hunt effect, section
    4.1.3)."""
    delta = 6 / 29
    root = torch.where(xyz > delta**3, xyz.clamp(min=delta**3) ** (1 / 3), xyz / (3 * delta**2) + 4 / 29)
    x, y, z = root.split(1, dim=1)
    lightness = 116 * y - 16
    chroma = 0.01 * lightness
    return torch.cat((lightness, chroma * 500 * (x - y), chroma * 200 * (y - z)), dim=1)


def _hyab(a: Tensor, b: Tensor) -> Float[Tensor, "n h w"]:
    """Colour distance: city-block in lightness, Euclidean in chroma."""
    difference = a - b
    return difference[:, 0].abs() + difference[:, 1:].square().sum(1).sqrt()


def _filter(maps: Tensor, along_y: Tensor, along_x: Tensor) -> Tensor:
    ry, rx = len(along_y) // 2, len(along_x) // 2
    return correlate(F.pad(maps, (rx, rx, ry, ry), mode="replicate"), along_y, along_x)


def _filter_sensitivity(ycc: Tensor, ppd: float) -> Tensor:
    """Filter each channel of YCxCz [n, 3, h, w] by the contrast sensitivity of the eye at ``ppd`` pixels
    per degree (section 4.1.1)."""
    widest = max(b for _, b in itertools.chain.from_iterable(_SENSITIVITY.values()))
    radius = math.ceil(3 * math.sqrt(widest / (2 * math.pi**2)) * ppd)
    x = torch.arange(-radius, radius + 1, dtype=ycc.dtype, device=ycc.device) / ppd
    filtered = []
    for channel, terms in zip(ycc.split(1, dim=1), _SENSITIVITY.values(), strict=True):
        kernels = [torch.exp(-(math.pi**2) * x.square() / b) for _, b in terms]
        masses = []
        parts = []
        for (amplitude, width), kernel in zip(terms, kernels, strict=True):
            total = kernel.sum()
            mass = amplitude * math.sqrt(math.pi / width) * total**2
            masses.append(mass)
            parts.append(_filter(channel, kernel / total, kernel / total) * mass)
        filtered.append(sum(parts) / sum(masses))
    return torch.cat(filtered, dim=1)


def _color_difference(first: Tensor, second: Tensor, ppd: float) -> Float[Tensor, "n h w"]:
    """Colour difference of YCxCz images, scaled to [0, 1] (section 4.1)."""
    to_xyz, to_rgb = _xyz_matrices(first)

    def perceived(ycc: Tensor) -> Tensor:
        """Perceived colours, as Hunt-adjusted CIELab."""
        rgb = _transform_colors(_from_opponent(_filter_sensitivity(ycc, ppd)), to_rgb).clamp(0, 1)
        return _hunt_lab(_transform_colors(rgb, to_xyz))

    error = _hyab(perceived(first), perceived(second)) ** _COLOR_EXPONENT
    green, blue = (_hunt_lab(to_xyz[None, :, i, None, None]) for i in (1, 2))
    largest = _hyab(green, blue) ** _COLOR_EXPONENT
    knee = _KNEE * largest
    above = _KNEE_VALUE + (error - knee) / (largest - knee) * (1 - _KNEE_VALUE)
    return torch.where(error < knee, _KNEE_VALUE / knee * error, above)


def _features(lightness: Tensor, ppd: float) -> tuple[Tensor, Tensor]:
    """Strength of edges and of points [n, h, w] in lightness [n, 1, h, w] in [0, 1] (section 4.2)."""
    sigma = 0.5 * _FEATURE_WIDTH * ppd
    radius = math.ceil(3 * sigma)
    x = torch.arange(-radius, radius + 1, dtype=lightness.dtype, device=lightness.device)
    bell = torch.exp(-x.square() / (2 * sigma**2))
    strengths = []
    for kernel in (-x * bell, (x.square() / sigma**2 - 1) * bell):
        positive, negative = kernel.clamp(min=0), kernel.clamp(max=0)
        kernel = positive / positive.sum() - negative / negative.sum()
        gx = _filter(lightness, bell / bell.sum(), kernel)
        gy = _filter(lightness, kernel, bell / bell.sum())
        strengths.append((gx.square() + gy.square()).sqrt()[:, 0])
    return strengths[0], strengths[1]


def flip_map(image: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n h w"]:
    """FLIP of each pixel.

    Args:
        image: sRGB; values outside [0, 1] are clamped.
        target: sRGB; values outside [0, 1] are clamped.

    Returns:
        Maps in [0, 1], 0 where the images are equal."""
    # Image and target separately, not as one batch: rounding can depend on the position in memory, and
    # equal images must give 0.
    with exact(image.device.type):
        image = at_least_float32(image).clamp(0, 1)
        target = at_least_float32(target).clamp(0, 1)
        to_xyz, _ = _xyz_matrices(image)
        first = _opponent(_transform_colors(_linear_rgb(image), to_xyz))
        second = _opponent(_transform_colors(_linear_rgb(target), to_xyz))
        color = _color_difference(first, second, PIXELS_PER_DEGREE)
        edges, points = _features((first[:, :1] + 16) / 116, PIXELS_PER_DEGREE)
        target_edges, target_points = _features((second[:, :1] + 16) / 116, PIXELS_PER_DEGREE)
        difference = torch.maximum((edges - target_edges).abs(), (points - target_points).abs())
        feature = (difference / math.sqrt(2)).clamp(0, 1) ** _FEATURE_EXPONENT
        return color.clamp(0, 1) ** (1 - feature)
