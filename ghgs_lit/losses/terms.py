"""Terms of the training loss.

Every term takes a prediction, its Gaussians rendered from the batch's target cameras, and the
batch, and returns a scalar in float32 or wider. A term is a function, or a class whose instances,
built without arguments, are called; :mod:`ghgs_lit.config.registry` lists them by name."""

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from ghgs_lit.errors import InputError
from ghgs_lit.extents import extents
from ghgs_lit.geometry.chamfer import chamfer as chamfer_distance
from ghgs_lit.geometry.chamfer import chamfer_of_rows
from ghgs_lit.geometry.masks import coverage
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.metrics.functional import SSIM_WINDOW, ssim_map
from ghgs_lit.metrics.protocol import LPIPS
from ghgs_lit.ops.pool import have_values
from ghgs_lit.types import Batch, Prediction, Rendering

Scalar = Float[Tensor, ""]


def render_l1(prediction: Prediction, rendering: Rendering, batch: Batch) -> Scalar:
    """Mean |render - target| over the whole image (first term of the paper's L_render).

    Args:
        prediction: not used.
        rendering: images [B, T, 3, h, w].
        batch: with targets of that shape, in [0, 1].

    Returns:
        The mean over all pixels and channels, in units of the images."""
    return (at_least_float32(rendering.image) - at_least_float32(batch.targets.images)).abs().mean()


def render_ssim(prediction: Prediction, rendering: Rendering, batch: Batch) -> Scalar:
    """1 - SSIM over the whole image without padding, as the authors train (second term of L_render).

    On a CPU, only windows in which the images differ are computed; elsewhere the term is 0.

    Args:
        prediction: not used.
        rendering: images [B, T, 3, h, w].
        batch: with targets of that shape, in [0, 1].

    Returns:
        The mean over all windows and channels, in [0, 2].

    Raises:
        InputError: the images are smaller than the SSIM window."""
    image = rendering.image.flatten(0, 1)
    target = batch.targets.images.flatten(0, 1)
    reach = SSIM_WINDOW - 1
    count, channels, height, width = image.shape
    if image.device.type == "cpu" and have_values(image, target):
        (seen,) = extents((image != target).any(1).any(0, keepdim=True))
        rows = slice(max(seen.top - reach, 0), seen.bottom + reach)
        columns = slice(max(seen.left - reach, 0), seen.right + reach)
        image, target = image[..., rows, columns], target[..., rows, columns]
    return (1 - ssim_map(image, target)).sum() / (count * channels * (height - reach) * (width - reach))


def chamfer(prediction: Prediction, rendering: Rendering, batch: Batch, points: int | None = None) -> Scalar:
    """Chamfer distance between the subject's unprojected pixels and the body vertices (L_geom).

    Args:
        prediction: its points, before the Gaussian head's offset, in metres.
        rendering: not used.
        batch: with body vertices in metres.
        points: number of points of each set that are matched, sampled at random; None: all.

    Returns:
        The mean over the batch, in square metres.

    Raises:
        InputError: the data has no body vertices."""
    if batch.body_vertices is None:
        raise InputError("loss.weights.chamfer: expected 0 for data without body vertices; found more")
    used = prediction.points.valid & batch.masks
    rows = None
    if points is None and used.device.type != "cpu":
        rows = _rows_of_gaussians(prediction, used)
    values = []
    for element, vertices in enumerate(batch.body_vertices):
        if rows is not None and len(vertices):
            values.append(chamfer_of_rows(*(each[element] for each in rows), vertices))
        else:
            own = prediction.points.pixels[element][used[element]]
            values.append(chamfer_distance(own, vertices, points))
    return torch.stack(values).mean()


def _rows_of_gaussians(
    prediction: Prediction, used: Bool[Tensor, "B V H W"]
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...]] | None:
    """Points of the Gaussians' pixels, in fixed shapes without a device-to-host synchronisation.

    Args:
        prediction: each of its valid pixels has a Gaussian; a shape bucket may be filled up with
            Gaussians of the preceding pixel.
        used: pixels to use.

    Returns:
        Points [n, 3] of each element, and which of them to use [n]; None if Gaussians have no pixels.
    """
    gaussians = prediction.gaussians
    if gaussians.image is None or not all(gaussians.splits):
        return None
    place = gaussians.image * used[0, 0].numel() + gaussians.pixel
    is_new = F.pad(place[1:] != place[:-1], (1, 0), value=True)
    points = prediction.points.pixels.flatten(0, 3)[place]
    return points.split(gaussians.splits), (used.flatten()[place] & is_new).split(gaussians.splits)


def depth(prediction: Prediction, rendering: Rendering, batch: Batch) -> Scalar:
    """Mean |z - true z| over the subject's pixels with a true depth.

    With rounds, summed over the depths before the first round and after each, like RAFT's sequence
    loss (Teed and Deng, ECCV 2020) without its weights.

    Args:
        prediction: depths of each round [B, V, H, W] in metres.
        rendering: not used.
        batch: with true depths in metres, 0 where unknown.

    Returns:
        Metres; 0 if no pixel has a true depth.

    Raises:
        InputError: the data has no depth maps."""
    if batch.depths is None:
        raise InputError("loss.weights.depth: expected 0 for data without depth maps; found more")
    used = (coverage(batch) > 0) & prediction.depth_valid & (batch.depths > 0)
    truth = torch.where(used, batch.depths, 1)
    rounds = prediction.rounds or (prediction.depth_maps,)
    errors = [(torch.where(used, at_least_float32(maps.depth), truth) - truth).abs() for maps in rounds]
    return sum(error.sum() for error in errors) / used.sum().clamp(min=1)


def silhouette(prediction: Prediction, rendering: Rendering, batch: Batch) -> Scalar:
    """Mean |alpha - mask| over the target images.

    Args:
        prediction: not used.
        rendering: alpha [B, T, 1, h, w].
        batch: with masks of the targets [B, T, h, w].

    Returns:
        The mean over all pixels, in [0, 1]."""
    return (at_least_float32(rendering.alpha)[:, :, 0] - batch.targets.masks.float()).abs().mean()


class Perceptual:
    """LPIPS of the target images, as in the metric.

    Raises:
        InputError: the package or its weights are missing."""

    def __init__(self) -> None:
        self.metric = LPIPS(key="weights.lpips")

    def __call__(self, prediction: Prediction, rendering: Rendering, batch: Batch) -> Scalar:
        """Mean over the images.

        Args:
            prediction: not used.
            rendering: images [B, T, 3, h, w]; values outside [0, 1] are clamped.
            batch: with targets of that shape."""
        image = rendering.image.flatten(0, 1)
        self.metric.network.to(image.device)
        return self.metric(image, batch.targets.images.flatten(0, 1)).mean()
