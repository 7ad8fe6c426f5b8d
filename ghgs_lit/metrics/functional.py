"""Image metrics as pure functions: one value for each RGB image in [0, 1] (data range 1).

A ``region`` selects the pixels that count. Where it is empty the value is nan,
and averages leave it out."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import choice, require
from ghgs_lit.geometry.chamfer import nearest
from ghgs_lit.geometry.masks import between, first_and_last
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.runtime.precision import exact

REGIONS = ("image", "box", "subject", "crop", "edge")
PADDINGS = ("valid", "reflect", "zeros")
PSNR_CAP = 100.0
"""PSNR in dB of equal images, and the largest value reported:
float32 resolves no smaller errors."""
CROP = (1000 / 1024, 500 / 1024)
"""Height and width of the region ``crop`` as shares of the image's: 1000 x 500 of 1024 x 1024, as
published scripts of GHG and LIFe-GoM crop."""
EDGE, BESIDE, INNER = 2, 3, 4
"""Pixels from the subject's outline, in rows and columns: of the region ``edge`` at most, of what
:func:`spill` and :func:`sharpness` count more than and at least."""
DEPTH_STEP = 0.02
"""Least relative difference of the depths of neighbouring pixels at an edge of depth:
5 cm at 2.5 m."""
BRIGHTNESS = 0.40
"""Mean of the subject in the images that :func:`psnr_box_40` compares:
that of well lit photographs."""
SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
"""Side and standard deviation, in pixels, of SSIM's Gaussian window."""


def mean_over(values: Float[Tensor, "n h w"], region: Bool[Tensor, "n h w"] | None) -> Float[Tensor, " n"]:
    """Mean of each map over its region.

    Args:
        values: maps of a metric.
        region: the pixels that count; None: all.

    Returns:
        A mean for each map; nan where the region is empty."""
    if region is None:
        return values.mean((-2, -1))
    count = region.sum((-2, -1))
    total = torch.where(region, values, torch.zeros_like(values)).sum((-2, -1))
    return torch.where(count > 0, total / count.clamp(min=1), torch.full_like(total, torch.nan))


def mean_inside(
    values: Float[Tensor, "n hh ww"], region: Bool[Tensor, "n h w"] | None
) -> Float[Tensor, " n"]:
    """:func:`mean_over` for maps that may lack the image's border.

    Args:
        values: maps, as large as the image or smaller by the same border on opposite sides.
        region: the pixels of the image that count, whose border is cut off, too; None: all.

    Returns:
        A mean for each map; nan where what is left of the region is empty."""
    if region is not None:
        top = (region.shape[1] - values.shape[1]) // 2
        left = (region.shape[2] - values.shape[2]) // 2
        region = region[:, top : top + values.shape[1], left : left + values.shape[2]]
    return mean_over(values, region)


def box_of(mask: Bool[Tensor, "n h w"]) -> Bool[Tensor, "n h w"]:
    """The bounding box of each mask, as a mask; empty where the mask is empty."""
    return between(mask.any(-1))[:, :, None] & between(mask.any(-2))[:, None, :]


def crop_of(mask: Bool[Tensor, "n h w"]) -> Bool[Tensor, "n h w"]:
    """A window of :data:`CROP` around the middle of each mask's box.

    Args:
        mask: of the subject.

    Returns:
        The window, moved into the image, as a mask; empty where the mask is empty."""

    def span(hit: Bool[Tensor, "n k"], share: float) -> Bool[Tensor, "n k"]:
        """Rows or columns of the window, from those that the mask hits."""
        count = hit.shape[1]
        side = round(share * count)
        index = torch.arange(count, device=hit.device)
        first, last = first_and_last(hit)
        start = (first - (side - (last - first + 1)) // 2).clamp(0, count - side)[:, None]
        return (index >= start) & (index < start + side) & hit.any(-1, keepdim=True)

    height, width = CROP
    return span(mask.any(-1), height)[:, :, None] & span(mask.any(-2), width)[:, None, :]


def grown(mask: Bool[Tensor, "n h w"], pixels: int) -> Bool[Tensor, "n h w"]:
    """Dilate masks.

    Args:
        mask: True where something is.
        pixels: largest distance in rows and in columns.

    Returns:
        Each mask with all pixels at most so far away."""
    return F.max_pool2d(mask[:, None].float(), 2 * pixels + 1, 1, pixels)[:, 0].bool()


def depth_edges(depth: Float[Tensor, "n h w"]) -> Bool[Tensor, "n h w"]:
    """Pixels on both sides of an edge of depth:
    beside a neighbour :data:`DEPTH_STEP` nearer or farther.

    Args:
        depth: z in metres; 0 is unknown, and no edge.

    Returns:
        A mask of each map."""
    edges = torch.zeros_like(depth, dtype=torch.bool)
    for axis in (1, 2):
        count = depth.shape[axis] - 1
        first = depth.narrow(axis, 0, count)
        second = depth.narrow(axis, 1, count)
        nearer = torch.minimum(first, second)
        is_edge = (nearer > 0) & ((first - second).abs() > DEPTH_STEP * nearer)
        edges.narrow(axis, 0, count).logical_or_(is_edge)
        edges.narrow(axis, 1, count).logical_or_(is_edge)
    return edges


def region_of(
    mask: Bool[Tensor, "n h w"], name: str, depth: Float[Tensor, "n h w"] | None = None
) -> Bool[Tensor, "n h w"] | None:
    """The pixels of a region.

    Args:
        mask: of the subject.
        name: one of :data:`REGIONS`.
        depth: true z in metres, 0 where unknown; its edges belong to ``edge``. None: unknown.

    Returns:
        A mask; None for the whole image.

    Raises:
        InputError: there is no such region."""
    choice("region", name, REGIONS)
    if name == "image":
        return None
    if name == "crop":
        return crop_of(mask)
    if name == "edge":
        outline = grown(mask, EDGE) & grown(~mask, EDGE)
        return outline if depth is None else outline | grown(depth_edges(depth), EDGE - 1)
    return box_of(mask) if name == "box" else mask


def squared_error(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"]
) -> Float[Tensor, "n h w"]:
    """Squared error of each pixel, averaged over the channels.

    Args:
        image: renders.
        target: photographs in [0, 1].

    Returns:
        Maps in float32 or wider."""
    return (at_least_float32(image) - at_least_float32(target)).square().mean(1)


def decibels(mse: Float[Tensor, " n"]) -> Float[Tensor, " n"]:
    """PSNR of a mean squared error.

    Args:
        mse: for a data range of 1.

    Returns:
        ``-10 log10(MSE)``, at most :data:`PSNR_CAP`; nan stays nan."""
    return -10 * mse.clamp(min=10 ** (-PSNR_CAP / 10)).log10()


def psnr(
    image: Float[Tensor, "n c h w"],
    target: Float[Tensor, "n c h w"],
    region: Bool[Tensor, "n h w"] | None = None,
) -> Float[Tensor, " n"]:
    """Peak signal-to-noise ratio.

    Args:
        image: renders.
        target: photographs in [0, 1].
        region: the pixels that count; None: all.

    Returns:
        dB for each image, at most :data:`PSNR_CAP`; nan where the region is empty."""
    return decibels(mean_over(squared_error(image, target), region))


def psnr_box_40(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], mask: Bool[Tensor, "n h w"]
) -> Float[Tensor, " n"]:
    """PSNR in the subject's box of images that are scaled so that the subject's mean is
    :data:`BRIGHTNESS`.

    Errors grow with light: the same prediction of a person lit twice as brightly has 6 dB less.
    Scaled, dark and bright people can be compared. Values above 1 stay.

    Args:
        image: renders.
        target: photographs in [0, 1].
        mask: of the subject.

    Returns:
        dB for each image, at most :data:`PSNR_CAP`; nan where the subject is empty or black."""
    light = mean_over(at_least_float32(target).mean(1), mask)
    gain = torch.where(light > 0, BRIGHTNESS / light, torch.nan)
    return decibels(mean_over(squared_error(image, target), box_of(mask)) * gain.square())


def _gaussian_window(like: Tensor) -> Float[Tensor, " size"]:
    """Weights of SSIM's window along one side, with sum 1."""
    x = torch.arange(SSIM_WINDOW, dtype=like.dtype, device=like.device) - (SSIM_WINDOW - 1) / 2
    weights = torch.exp(-x.square() / (2 * SSIM_SIGMA**2))
    return weights / weights.sum()


def correlate(
    maps: Float[Tensor, "n c h w"], along_y: Float[Tensor, " ky"], along_x: Float[Tensor, " kx"]
) -> Float[Tensor, "n c hh ww"]:
    """Filter every map with a separable kernel, without padding.

    Args:
        maps: to filter.
        along_y: kernel along columns.
        along_x: kernel along rows.

    Returns:
        Maps smaller by the kernels' lengths minus 1."""
    n, c, h, w = maps.shape
    # All maps are channels of one depthwise convolution:
    # ten times faster on a CPU than a batch of maps.
    flat = maps.reshape(1, n * c, h, w)
    flat = F.conv2d(flat, along_y.expand(n * c, 1, -1)[..., None].contiguous(), groups=n * c)
    flat = F.conv2d(flat, along_x.expand(n * c, 1, 1, -1).contiguous(), groups=n * c)
    return flat.reshape(n, c, *flat.shape[-2:])


def ssim_map(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], padding: str = "valid"
) -> Float[Tensor, "n c hh ww"]:
    """Structural similarity (Wang et al. 2004), K = 0.01, 0.03, moments in float32 or wider.

    Args:
        image: renders.
        target: photographs in [0, 1].
        padding: ``valid`` gives only the pixels whose window lies inside the image (scikit-image
            averages these); the others keep the image's size: ``reflect`` mirrors the image at its
            border (torchmetrics), ``zeros`` surrounds it with black (the authors' evaluation).

    Returns:
        The similarity of each window in [-1, 1].

    Raises:
        InputError: images smaller than the window, unless padded with zeros; no such padding."""
    choice("ssim.padding", padding, PADDINGS)
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
    image: Float[Tensor, "n c h w"],
    target: Float[Tensor, "n c h w"],
    padding: str = "valid",
    region: Bool[Tensor, "n h w"] | None = None,
) -> Float[Tensor, " n"]:
    """Mean structural similarity.

    Args:
        image: renders.
        target: photographs in [0, 1].
        padding: as of :func:`ssim_map`.
        region: the pixels that count, where the map covers them; None: all.

    Returns:
        The mean over channels and pixels of each image; nan where the region is empty.

    Raises:
        InputError: as :func:`ssim_map`."""
    return mean_inside(ssim_map(image, target, padding).mean(1), region)


def spill(
    image: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"], mask: Bool[Tensor, "n h w"]
) -> Float[Tensor, " n"]:
    """Light that is drawn beside the subject, farther than :data:`BESIDE` pixels from its mask.

    Args:
        image: renders on black.
        target: photographs on black, in [0, 1].
        mask: of the subject.

    Returns:
        Per mille of the subject's light in the target; nan where that has none."""
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
        target: photographs in [0, 1].
        mask: of the subject.

    Returns:
        The energy over the target's: 1 is right, less is blurred, more is ragged; nan where the
        target has none."""
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
        truth: in metres; 0 is unknown.
        region: the pixels that count.

    Returns:
        Millimetres; nan if no pixel counts.

    Raises:
        InputError: depths of different shapes."""
    region = region & (truth > 0)
    require(depth.shape == truth.shape, "depth", f"shape {tuple(truth.shape)}", tuple(depth.shape))
    return 1000 * (at_least_float32(depth)[region] - at_least_float32(truth)[region]).abs().mean()


#: Opacity from which on a Gaussian stands for the surface.
_OPAQUE = 0.5


def surface_error_mm(
    means: Float[Tensor, "n 3"], opacities: Float[Tensor, " n"], surface: Float[Tensor, "m 3"]
) -> Float[Tensor, ""]:
    """Distance of Gaussians to the surface, and of the surface to the nearest Gaussian;
    the mean of both.

    It sees where Gaussians end, after all offsets, where :func:`depth_error_mm` ends before them;
    points of the surface are about a pixel apart, and so is the least value.

    Args:
        means: of Gaussians, in metres; those that are not finite are left out.
        opacities: in [0, 1], by which distances to the surface are weighted; those to a Gaussian
            are to one of opacity 0.5 or more.
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
