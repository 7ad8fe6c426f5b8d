"""Metrics as pure functions: one value per RGB image in [0, 1] (data range 1).

A region (:mod:`ghgs_lit.metrics.regions`) selects pixels. If it is empty the value is nan, which
averages ignore."""

import flip_evaluator
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.geometry.chamfer import nearest
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.metrics.regions import box_of, grown, mean_over

PSNR_CAP = 100.0
"""Largest PSNR in dB, that of equal images: float32 does not resolve smaller errors."""
BESIDE = 3
"""Rows or columns from the subject's outline beyond which :func:`spill` measures."""
INNER = 4
"""Least distance in rows and columns from the subject's outline of pixels in :func:`sharpness`."""
BRIGHTNESS = 0.40
"""Mean of the subject to which :func:`psnr_box_40` scales images, as in well lit photographs."""
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
"""Side and standard deviation, in pixels, of SSIM's Gaussian window."""


def squared_error(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"]
) -> Float[Tensor, "n h w"]:
    """Squared error of each pixel, averaged over the channels, in float32 or wider."""
    return (at_least_float32(image) - at_least_float32(target)).square().mean(1)


def decibels(mse: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """PSNR of a mean squared error for a data range of 1: ``-10 log10(MSE)``, at most
    :data:`PSNR_CAP`; nan stays nan."""
    return -10 * mse.clamp(min=10 ** (-PSNR_CAP / 10)).log10()


def psnr(
    image: Float[Tensor, "n c h w"],
    target: Float[Tensor, "n c h w"],
    region: Bool[Tensor, "n h w"] | None = None,
) -> Float[Tensor, " n"]:
    """Peak signal-to-noise ratio.

    Args:
        image: renders.
        target: images in [0, 1].
        region: pixels to average over; None: all.

    Returns:
        dB per image, at most :data:`PSNR_CAP`; nan if the region is empty."""
    return decibels(mean_over(squared_error(image, target), region))


def psnr_box_40(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], mask: Bool[Tensor, "n h w"]
) -> Float[Tensor, " n"]:
    """PSNR in the subject's box of images scaled to a mean of :data:`BRIGHTNESS` over the subject.

    Errors are proportional to brightness: the same prediction of a person lit twice as brightly has
    6 dB less. Scaling makes dark and bright people comparable. Values above 1 are not clamped.

    Args:
        image: renders.
        target: images in [0, 1].
        mask: of the subject.

    Returns:
        dB per image, at most :data:`PSNR_CAP`; nan if the subject is empty or black."""
    light = mean_over(at_least_float32(target).mean(1), mask)
    gain = torch.where(light > 0, BRIGHTNESS / light, torch.nan)
    return decibels(mean_over(squared_error(image, target), box_of(mask)) * gain.square())


def _gaussian_window(like: Tensor) -> Float[Tensor, " size"]:
    """Weights of SSIM's window along one axis, with sum 1."""
    x = torch.arange(SSIM_WINDOW, dtype=like.dtype, device=like.device) - (SSIM_WINDOW - 1) / 2
    weights = torch.exp(-x.square() / (2 * SSIM_SIGMA**2))
    return weights / weights.sum()


def correlate(
    maps: Float[Tensor, "n c h w"], along_y: Float[Tensor, " ky"], along_x: Float[Tensor, " kx"]
) -> Float[Tensor, "n c hh ww"]:
    """Filter every map with a separable kernel, without padding: maps shrink by the kernels' lengths
    minus 1.

    Args:
        maps: maps to filter.
        along_y: vertical kernel.
        along_x: horizontal kernel."""
    n, c, h, w = maps.shape
    # One depthwise convolution with all maps as channels: ten times faster on a CPU than as a batch.
    flat = maps.reshape(1, n * c, h, w)
    flat = F.conv2d(flat, along_y.expand(n * c, 1, -1)[..., None].contiguous(), groups=n * c)
    flat = F.conv2d(flat, along_x.expand(n * c, 1, 1, -1).contiguous(), groups=n * c)
    return flat.reshape(n, c, *flat.shape[-2:])


def ssim_map(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], padding: str = "valid"
) -> Float[Tensor, "n c hh ww"]:
    """Structural similarity (Wang et al., 2004), K = 0.01, 0.03, moments in float32 or wider.

    Args:
        image: renders.
        target: images in [0, 1].
        padding: ``valid``: only pixels whose window lies inside the image (scikit-image averages
            these); the others keep the image's size: ``reflect`` mirrors it at its border
            (torchmetrics), ``zeros`` pads it with black (the authors' evaluation).

    Returns:
        The similarity of each window in [-1, 1].

    Raises:
        InputError: the images are smaller than the window and not padded with zeros."""
    found = tuple(image.shape[-2:])
    large = padding == "zeros" or min(found) >= SSIM_WINDOW
    expected = f"images of at least {SSIM_WINDOW}x{SSIM_WINDOW} pixels, or padding zeros"
    require(large, "ssim", expected, found)
    with exact(image.device.type):
        x, y = at_least_float32(image), at_least_float32(target)
        if padding != "valid":
            border, mode = [SSIM_WINDOW // 2] * 4, "reflect" if padding == "reflect" else "constant"
            x, y = F.pad(x, border, mode), F.pad(y, border, mode)
        moments = torch.cat((x, y, x * x + y * y, x * y), dim=1)
        weights = _gaussian_window(moments)
        blurred = correlate(moments, weights, weights)
        mx, my, squares, product = blurred.chunk(4, dim=1)
        both = mx * my
        of_means = mx * mx + my * my
        c1, c2 = 0.01**2, 0.03**2
        return (2 * both + c1) / (of_means + c1) * (2 * (product - both) + c2) / (squares - of_means + c2)


def ssim(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], padding: str = "valid"
) -> Float[Tensor, " n"]:
    """Mean of :func:`ssim_map` over channels and pixels of each image."""
    return ssim_map(image, target, padding).mean((1, 2, 3))


def flip_map(image: Float[Tensor, "n 3 h w"], target: Float[Tensor, "n 3 h w"]) -> Float[Tensor, "n h w"]:
    """FLIP of each pixel, by its authors' package at its default of 67 pixels a degree, on the CPU.

    P. Andersson, J. Nilsson, T. Akenine-Möller, M. Oskarsson, K. Åström, M. D. Fairchild, "FLIP: A
    Difference Evaluator for Alternating Images", HPG 2020.

    Args:
        image: sRGB; values outside [0, 1] are clamped.
        target: sRGB; values outside [0, 1] are clamped.

    Returns:
        Maps in [0, 1], 0 where the images are equal, NaN where one is NaN; float32, on the device of
        ``image``."""
    maps = []
    for pair in zip(target, image, strict=True):
        arrays = [each.float().clamp(0, 1).permute(1, 2, 0).contiguous().cpu().numpy() for each in pair]
        values, *_ = flip_evaluator.evaluate(*arrays, "LDR", applyMagma=False, computeMeanError=False)
        is_nan = np.isnan(arrays).any((0, -1))  # the package counts NaN as a colour
        maps.append(np.where(is_nan, np.float32(np.nan), values[..., 0]))
    return torch.from_numpy(np.stack(maps)).to(image.device)


def spill(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], mask: Bool[Tensor, "n h w"]
) -> Float[Tensor, " n"]:
    """Light rendered outside the subject, farther than :data:`BESIDE` pixels from its mask.

    Args:
        image: renders on black.
        target: images on black, in [0, 1].
        mask: of the subject.

    Returns:
        Per mille of the subject's light in the target; nan if that is 0."""
    drawn = at_least_float32(image).clamp(min=0).mean(1)
    true = at_least_float32(target).mean(1)
    light = torch.where(mask, true, 0).sum((-2, -1))
    beside = torch.where(grown(mask, BESIDE), 0, drawn).sum((-2, -1))
    return torch.where(light > 0, 1000 * beside / torch.where(light > 0, light, 1), torch.nan)


def sharpness(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], mask: Bool[Tensor, "n h w"]
) -> Float[Tensor, " n"]:
    """Energy of the Laplacian inside the subject, :data:`INNER` pixels or more from its outline.

    Args:
        image: renders.
        target: images in [0, 1].
        mask: of the subject.

    Returns:
        The energy relative to the target's: 1 is ideal, less is blurred, more is noisy; nan if the
        target's is 0."""
    inner = (mask & ~grown(~mask, INNER))[:, 1:-1, 1:-1]
    with exact(image.device.type):
        energies = []
        for picture in (at_least_float32(image), at_least_float32(target)):
            around = picture[..., :-2, 1:-1] + picture[..., 2:, 1:-1]
            around = around + picture[..., 1:-1, :-2] + picture[..., 1:-1, 2:]
            laplacian = around - 4 * picture[..., 1:-1, 1:-1]
            energies.append(torch.where(inner, laplacian.square().sum(1), 0).sum((-2, -1)))
    drawn, true = energies
    return torch.where(true > 0, drawn / torch.where(true > 0, true, 1), torch.nan)


def depth_error_mm(
    depth: Float[Tensor, "n h w"], truth: Float[Tensor, "n h w"], region: Bool[Tensor, "n h w"]
) -> Float[Tensor, ""]:
    """Mean |z - true z| over pixels with a true depth.

    Args:
        depth: predicted, in metres.
        truth: in metres; 0: unknown.
        region: pixels to average over.

    Returns:
        Millimetres; nan without such pixels."""
    region = region & (truth > 0)
    return 1000 * (at_least_float32(depth)[region] - at_least_float32(truth)[region]).abs().mean()


#: Least opacity of Gaussians that represent the surface.
_OPAQUE = 0.5


def surface_error_mm(
    means: Float[Tensor, "n 3"], opacities: Float[Tensor, " n"], surface: Float[Tensor, "m 3"]
) -> Float[Tensor, ""]:
    """Mean of two distances: from Gaussians to the surface, and from the surface to the nearest opaque
    Gaussian.

    Unlike :func:`depth_error_mm`, it measures Gaussians after all offsets. Points of the surface are
    about a pixel apart, which limits the least value.

    Args:
        means: centres of Gaussians in metres; those that are not finite are left out.
        opacities: in [0, 1], the weights of distances to the surface; distances from the surface are
            to Gaussians with an opacity of 0.5 or more.
        surface: points, in metres.

    Returns:
        Millimetres; nan without Gaussians or surface, infinite without opaque Gaussians."""
    finite = means.isfinite().all(1) & opacities.isfinite()
    means = at_least_float32(means[finite])
    opacities = at_least_float32(opacities[finite])
    surface = at_least_float32(surface)
    if len(means) == 0 or len(surface) == 0 or not bool(opacities.sum() > 0):
        return surface.new_tensor(torch.nan)
    there = (means - surface[nearest(means, surface)]).norm(dim=1)
    there = (there * opacities).sum() / opacities.sum()
    opaque = means[opacities >= _OPAQUE]
    if len(opaque) == 0:
        return surface.new_tensor(torch.inf)
    back = (surface - opaque[nearest(surface, opaque)]).norm(dim=1).mean()
    return 500 * (there + back)
