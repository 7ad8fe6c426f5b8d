"""How far the result of a preset is from the yardstick's."""

import math

import pandas as pd
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ghgs_lit.metrics.functional import decibels, squared_error
from ghgs_lit.types import Gaussians, Prediction, Rendering

ATTRIBUTES = ("means", "quaternions", "scales", "opacities", "colors")


def relative_difference(found: Tensor, expected: Tensor, norm: float = math.inf) -> float:
    """``|found - expected| / max|expected|``; infinite where a value is not finite or all of ``expected`` is
    0 and ``found`` is not; 0 where there are no values. ``norm``: of the difference: the largest of all
    values, or 2 for their root mean square."""
    if found.numel() == 0:
        return 0.0
    difference = (found - expected).double().abs()
    difference = (difference.max() if norm == math.inf else difference.square().mean().sqrt()).item()
    if not math.isfinite(difference):
        return math.inf
    largest = expected.abs().max().item()
    return difference / largest if largest > 0 else (0.0 if difference == 0 else math.inf)


def partners(found: Gaussians, expected: Gaussians) -> tuple[Int[Tensor, " n"], Int[Tensor, " n"]]:
    """Indices of the Gaussians that belong to the same input pixel in both. A preset may drop or merge
    Gaussians: those without a partner are left out."""
    if found.image is None or expected.image is None:
        n = min(len(found), len(expected))
        return torch.arange(n), torch.arange(n)
    frames = [pd.DataFrame({"image": g.image.cpu(), "pixel": g.pixel.cpu()}) for g in (found, expected)]
    frames = [frame.rename_axis(name).reset_index() for frame, name in zip(frames, ("a", "b"), strict=True)]
    both = frames[0].merge(frames[1], on=["image", "pixel"])
    device = found.means.device
    return tuple(torch.tensor(both[name].to_numpy().copy(), device=device) for name in ("a", "b"))


def differences(
    found: tuple[Prediction, Rendering], expected: tuple[Prediction, Rendering], masks: Bool[Tensor, "..."]
) -> dict[str, float]:
    """What a preset changes. ``masks``: of the inputs [B, V, H, W]. Returns: :func:`relative_difference` of
    each attribute of the Gaussians, of the ``render`` (root mean square) and of the ``depth`` of the
    subject's pixels; their largest, ``max_rel_diff``; ``psnr_to_none`` in dB of the renders; and
    ``unmatched``, the part of the yardstick's Gaussians that have no partner, or more than the preset's own
    that have none."""
    (prediction, rendering), (yardstick, reference) = found, expected
    ours, theirs = prediction.gaussians, yardstick.gaussians
    a, b = partners(ours, theirs)
    result = {n: relative_difference(getattr(ours, n)[a], getattr(theirs, n)[b]) for n in ATTRIBUTES}
    # Not the largest: a Gaussian that covers 1/255 of a pixel up to rounding is drawn there or not.
    result["render"] = relative_difference(rendering.image, reference.image, norm=2)
    valid = prediction.depth_valid & yardstick.depth_valid & masks
    result["depth"] = relative_difference(prediction.depth[valid], yardstick.depth[valid])
    error = squared_error(rendering.image.flatten(0, 1), reference.image.flatten(0, 1)).mean()
    missing = max(len(theirs), len(ours)) - len(a)
    return {
        **result,
        "max_rel_diff": max(result.values()),
        "psnr_to_none": decibels(error[None]).item(),
        "unmatched": missing / max(len(theirs), 1),
    }
