"""Gaussians in the compact formats of 3DGS viewers.

They store few bits: ``docs/outputs.md`` has their sizes and what is lost.
"""

import numpy as np
import torch

from ghgs_lit.types import Gaussians

CONVERTED = {"compressed_ply": "compressed.ply", "spz": "spz", "sog": "sog"}
"""Formats that the package gaussforge makes from a PLY; what it, and the suffix of files, calls each."""

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
"""One Gaussian of ``.splat``, which has no header: position and standard deviations, colour and opacity, and
the rotation (w, x, y, z), of which 128 is zero."""


def converted(ply: bytes, name: str) -> bytes:
    """The content of a file of another format.

    Args:
        ply: of a file of :func:`ghgs_lit.prediction.export.ply.write_ply`.
        name: one of ``CONVERTED``.

    Raises:
        RuntimeError: gaussforge refuses.
    """
    from gaussforge import GaussForge

    answer = GaussForge().convert(ply, "ply", CONVERTED[name])
    if answer.get("error"):
        raise RuntimeError(f"{name}: gaussforge: {answer['error']}")
    return answer["data"]


def to_records(gaussians: Gaussians) -> np.ndarray:
    """The records [N] of dtype ``RECORD`` of the Gaussians of one subject with RGB colours.

    Large and opaque ones come first, so that a part of a ``.splat`` file is a picture, too.
    """
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
