"""Gaussians as ``.splat``: 32 bytes each, without a header, for viewers in browsers.

Position and standard deviations as three float32 each, then colour and opacity as four bytes, then the
rotation as four bytes (w, x, y, z), of which 128 is zero. Large and opaque Gaussians come first, so that a
part of the file is a picture, too.
"""

import numpy as np
import torch

from ghgs_lit.types import Gaussians

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def to_records(gaussians: Gaussians) -> np.ndarray:
    """The records [N] of dtype ``RECORD`` of the Gaussians of one subject with RGB colours."""
    size = gaussians.scales.double().prod(-1) * gaussians.opacities
    order = size.argsort(descending=True, stable=True)
    means, scales, quaternions, opacities, colors = (
        getattr(gaussians, name)[order].detach().float().cpu()
        for name in ("means", "scales", "quaternions", "opacities", "colors")
    )
    records = np.empty(len(order), RECORD)
    records["mean"], records["scale"] = means.numpy(), scales.numpy()
    rgba = torch.cat([colors, opacities[:, None]], dim=-1).clamp(0, 1) * 255
    records["color"] = rgba.round().byte().numpy()
    rotation = torch.nn.functional.normalize(quaternions, dim=-1) * 128 + 128
    records["rotation"] = rotation.round().clamp(0, 255).byte().numpy()
    return records
