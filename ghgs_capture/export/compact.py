"""Gaussians in the compact formats of 3DGS viewers; ``docs/evidence/outputs.md`` has sizes and losses."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from ghgs_lit.errors import InputError
from ghgs_lit.ply import ply_bytes, stored_values
from ghgs_lit.types import Gaussians

CONVERTED = {"compressed_ply": "compressed.ply", "spz": "spz", "sog": "sog"}
"""Formats that the package gaussforge makes from a PLY; what it, and the suffix of files, calls each."""

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
"""One Gaussian of ``.splat``, which has no header: position and standard deviations, colour and opacity, and
the rotation (w, x, y, z), of which 128 is zero."""


def converted(name: str, gaussians: Gaussians) -> bytes:
    """The content of a file in format ``name`` of ``CONVERTED``. InputError: it cannot be, as of none."""
    from gaussforge import GaussForge

    answer = GaussForge().convert(ply_bytes(gaussians), "ply", CONVERTED[name])
    if answer.get("error"):
        expected = "formats: expected Gaussians that gaussforge converts to"
        raise InputError(f"{expected} {name}; found {len(gaussians)}: {answer['error']}")
    return answer["data"]


def to_records(gaussians: Gaussians) -> np.ndarray:
    """The Gaussians of one subject (RGB colours) as records [N] of dtype ``RECORD``, large and opaque ones
    first, so that a part of a ``.splat`` file is a picture, too."""
    values = {name: value[visible_first(gaussians).cpu()] for name, value in stored_values(gaussians).items()}
    records = np.empty(len(gaussians), RECORD)
    records["mean"], records["scale"] = values["means"].numpy(), values["scales"].numpy()
    records["color"] = rgba(values).numpy()
    records["rotation"] = (values["quaternions"] * 128 + 128).round().clamp(0, 255).byte().numpy()
    return records


def visible_first(gaussians: Gaussians) -> Tensor:
    """Indices [N] of the Gaussians, large and opaque ones first."""
    size = gaussians.scales.double().prod(-1) * gaussians.opacities
    return size.argsort(descending=True, stable=True)


def rgba(values: Mapping[str, Tensor]) -> Tensor:
    """Colours and opacities [N, 4] uint8 of :func:`ghgs_lit.ply.stored_values`."""
    colors = torch.cat([values["colors"], values["opacities"][:, None]], dim=-1)
    return (colors.clamp(0, 1) * 255).round().byte()
