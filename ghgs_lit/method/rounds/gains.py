"""Photometric differences between cameras: gains (exposure or white balance) and gammas.

A point on the surface has the same colour in all views that see it, up to a gain per camera and
channel (as in panoramas: Brown and Lowe, IJCV 2007)."""

import dataclasses
import itertools

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghgs_lit.geometry.constants import constant
from ghgs_lit.geometry.masks import coverage, surface_colors
from ghgs_lit.geometry.precision import exact
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.method.rounds.observation import sample_maps
from ghgs_lit.rendering import render
from ghgs_lit.types import Batch, Gaussians

#: Distance in metres from a view's rendered surface at which a Gaussian's weight in that view is 1 / e.
_NEAR = 0.02
#: Colours closer than this to black or white get less weight, since they constrain a gain little.
_DARK = 0.05
#: Residual of log colours at which a Gaussian's weight is halved (wrong depths, shadows).
_OUTLIER = 0.15
#: Log gains well below this are probably estimation errors, and are shrunk towards 0.
_LEAST = 0.02
#: Weight of the prior (gains of 1) in Gaussians, which decides for views that share no surface. For
#: gammas: one Gaussian whose log brightness is 0.1 from the mean.
_PRIOR = 1.0
_PRIOR_OF_SLOPES = 0.1**2
#: Stride over Gaussians: a third of them is enough and takes a third of the time.
_EVERY = 3
#: Iterations of reweighting, for gains and for gammas, which start farther from the solution.
_STEPS = 5
_STEPS_OF_SLOPES = 15

#: Which rows are Gaussians; None: all.
Real = Bool[Tensor, " N"] | None


def equalize(gaussians: Gaussians, batch: Batch, real: Real = None) -> tuple[Gaussians, Batch]:
    """Estimate the gains of the cameras, and divide Gaussians' colours and input images by them.

    Args:
        gaussians: Gaussians of the batch with their pixels.
        batch: the input views.
        real: which rows are Gaussians; None: all.

    Returns:
        Gaussians with corrected colours, and the batch with corrected images and ``log_gains``.
    """
    logs = log_gains(gaussians, batch, real)
    colors = gaussians.colors * torch.exp(-logs).flatten(0, 1)[gaussians.image]
    return dataclasses.replace(gaussians, colors=colors), divide_by_gains(batch, logs)


def divide_by_gains(batch: Batch, logs: Float[Tensor, "B V 3"]) -> Batch:
    """Divide images by gains, and clamp them to [0, 1].

    Args:
        batch: with uncorrected images.
        logs: natural logarithms of the gains of each camera and channel.
    """
    images = (at_least_float32(batch.images) * torch.exp(-logs)[..., None, None]).clamp(0, 1)
    return batch.recolor(images=images, log_gains=logs)


@torch.no_grad()
def log_gains(gaussians: Gaussians, batch: Batch, real: Real = None) -> Float[Tensor, "B V 3"]:
    """Estimate natural logarithms of each camera's gains; 0 if views share no surface.

    Their mean is about 0, as images do not determine which camera is right. Pairs of views are
    compared at the Gaussians visible in both, with Cauchy weights, so that wrong depths matter little
    (gain compensation; Brown and Lowe, IJCV 2007).

    Args:
        gaussians: Gaussians of the batch with their pixels.
        batch: the input views.
        real: which rows are Gaussians; None: all.
    """
    with exact(gaussians.means.device.type):
        own, logs, theirs, weights = _compare_colors(gaussians, batch, real)
        ratios = logs - theirs
        b, views = batch.masks.shape[:2]
        gains = ratios.new_zeros(b, views, 3)
        for _ in range(_STEPS):
            between = (gains[:, None] - gains[:, :, None]).flatten(0, 1)[own]
            counted = weights / (1 + ((ratios - between) / _OUTLIER).square())
            sums = _sum_by_image(own, b * views, counted, counted * ratios)
            gains = _solve(*sums.view(2, b, views, views, 3))
        return gains * gains.square() / (gains.square() + _LEAST**2)


@torch.no_grad()
def log_gammas(gaussians: Gaussians, batch: Batch) -> Float[Tensor, "B V 3"]:
    """Estimate natural logarithms of cameras' gammas relative to the median camera's; about 0 if views
    share no surface.

    A gamma is the exponent of a camera's colours. If two views differ in gamma, log ratios of their
    colours change linearly with log brightness, while gains only shift them: lines are fitted to these,
    with Cauchy weights.

    Args:
        gaussians: Gaussians of the batch with their pixels.
        batch: the input views.
    """
    with exact(gaussians.means.device.type):
        own, logs, theirs, weights = _compare_colors(gaussians, batch)
        ratios = logs - theirs
        levels = (logs + theirs) / 2
        b, views = batch.masks.shape[:2]
        fitted = torch.zeros_like(ratios)
        for _ in range(_STEPS_OF_SLOPES):
            counted = weights / (1 + ((ratios - fitted) / _OUTLIER).square())
            total, *sums = _sum_by_image(own, b * views, counted, counted * ratios, counted * levels)
            ratio, level = (each / total.clamp(min=_PRIOR) for each in sums)
            away = levels - level[own]
            moments = _sum_by_image(own, b * views, counted * away.square(), counted * away * ratios)
            gammas = _solve(*moments.view(2, b, views, views, 3), _PRIOR_OF_SLOPES)
            between = (gammas[:, None] - gammas[:, :, None]).flatten(0, 1)[own]
            fitted = ratio[own] + between * away
        return gammas - gammas.quantile(0.5, 1, keepdim=True)


def _sum_by_image(
    own: Int[Tensor, " N"], images: int, *values: Float[Tensor, "N V 3"]
) -> Float[Tensor, "k I V 3"]:
    """Sum each of k values over the Gaussians of each of I images; ``own`` is each Gaussian's image."""
    stacked = torch.stack(values)
    return stacked.new_zeros(len(values), images, *stacked.shape[2:]).index_add_(1, own, stacked)


def _thin(gaussians: Gaussians) -> tuple[Gaussians, Int[Tensor, " n"]]:
    """Select every :data:`_EVERY`-th Gaussian of each element; returns them and their indices."""
    device = gaussians.means.device
    splits = gaussians.splits
    ends = list(itertools.accumulate(splits))
    kept = [torch.arange(end - n, end, _EVERY, device=device) for n, end in zip(splits, ends, strict=True)]
    index = torch.cat(kept)
    return gaussians.select(index, tuple(map(len, kept))), index


def _compare_colors(
    gaussians: Gaussians, batch: Batch, real: Real = None
) -> tuple[Int[Tensor, " N"], Float[Tensor, "N V 3"], Float[Tensor, "N V 3"], Float[Tensor, "N V 3"]]:
    """Sample the colours of some Gaussians in all views.

    Returns the image of each Gaussian, log colours in each view and in its own, and weights in [0, 1],
    0 where it is not visible."""
    depth = render(gaussians, batch.cameras).depth
    views = batch.masks.shape[1]
    gaussians, index = _thin(gaussians)
    shares = coverage(batch)[:, :, None]
    maps = torch.cat((batch.once(surface_colors) * shares, shares, depth), 2).to(batch.cameras.extrinsics)
    values, z, can_see = sample_maps(gaussians, batch.cameras, maps)
    color, share, depth = values.split((3, 1, 1), -1)
    color = color / torch.where(share > 0, share, 1)
    near = _NEAR if gaussians.metre is None else _NEAR * gaussians.metre[gaussians.image // views, None, None]
    weights = torch.where(can_see, torch.exp(-((z - depth) / near).square()), 0)
    weights = weights * (10 * share - 9).clamp(0, 1)
    if real is not None:
        weights = weights * real[index, None, None]
    weights = weights * (torch.minimum(color, 1 - color) / _DARK).clamp(0, 1)
    own = (gaussians.image % views)[:, None, None].expand(-1, 1, 3)
    logs = color.clamp(min=_DARK / 8).log()
    return gaussians.image, logs, logs.gather(1, own), weights * weights.gather(1, own)


def _solve(
    counts: Float[Tensor, "B V V 3"], differences: Float[Tensor, "B V V 3"], prior: float = _PRIOR
) -> Float[Tensor, "B V 3"]:
    """Least-squares logs of each view from differences between pairs of views.

    Args:
        counts: sums of weights at the Gaussians of own views (first V) in other views (last V).
        differences: weighted sums of logs of other views (last V) minus those of own views (first V).
        prior: weight of the prior that logs are 0.
    """
    counts = counts.movedim(-1, 1)
    differences = differences.movedim(-1, 1)
    both = counts + counts.mT
    identity = constant(torch.eye, both.shape[-1], like=both)
    laplacian = torch.add(identity * both.sum(-1, keepdim=True) - both, identity, alpha=prior)
    right = differences.sum(-2) - differences.sum(-1)
    # Never singular; linalg.solve would check that with a device-to-host synchronisation.
    return torch.linalg.solve_ex(laplacian, right).result.mT
