"""Gaussians in the compact formats of 3DGS viewers;
``docs/evidence/outputs.md`` has sizes and losses."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from ghgs_lit.errors import InputError
from ghgs_lit.ply import ply_bytes, stored_values
from ghgs_lit.types import Gaussians

CONVERTED = {"compressed_ply": "compressed.ply", "spz": "spz", "sog": "sog"}
"""Formats that the package gaussforge makes from a PLY;
what it, and the suffix of files, calls each."""

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])
"""One Gaussian of ``.splat``, which has no header: position and standard deviations, colour and
opacity, and the rotation (w, x, y, z), of which 128 is zero."""


def half_turned(gaussians: Gaussians) -> Gaussians:
    """Turn Gaussians by half a turn about x: from a PLY's axes (right, down, front) to those in
    which SPZ is stored (right, up, back), or back.

    https://github.com/nianticlabs/spz, "Coordinate System"; gaussforge stores numbers as they are.

    Args:
        gaussians: of any number of subjects; their colours must not depend on direction.

    Returns:
        The same with y and z of places, and with them those of quaternions, negated.
    """
    means = gaussians.means * gaussians.means.new_tensor([1, -1, -1])
    quaternions = gaussians.quaternions * gaussians.quaternions.new_tensor([1, 1, -1, -1])
    return replace(gaussians, means=means, quaternions=quaternions)


def converted(name: str, gaussians: Gaussians) -> bytes:
    """Convert Gaussians to another program's format, by the package gaussforge.

    Args:
        name: of the format, in ``CONVERTED``.
        gaussians: of one subject, with RGB colours.

    Returns:
        The content of a file.

    Raises:
        InputError: gaussforge cannot convert them, such as none.
    """
    from gaussforge import GaussForge

    if name == "spz":
        gaussians = half_turned(gaussians)
    answer = GaussForge().convert(ply_bytes(gaussians), "ply", CONVERTED[name])
    if answer.get("error"):
        expected = "formats: expected Gaussians that gaussforge converts to"
        raise InputError(f"{expected} {name}; found {len(gaussians)}: {answer['error']}")
    return answer["data"]


def to_records(gaussians: Gaussians) -> np.ndarray:
    """Store Gaussians as records of ``.splat``.

    Large and opaque ones come first, so that a part of a file is a picture, too.

    Args:
        gaussians: of one subject, with RGB colours.

    Returns:
        Records [N] of dtype ``RECORD``.
    """
    values = {name: value[visible_first(gaussians).cpu()] for name, value in stored_values(gaussians).items()}
    records = np.empty(len(gaussians), RECORD)
    records["mean"] = values["means"].numpy()
    records["scale"] = values["scales"].numpy()
    records["color"] = rgba(values).numpy()
    records["rotation"] = (values["quaternions"] * 128 + 128).round().clamp(0, 255).byte().numpy()
    return records


def visible_first(gaussians: Gaussians) -> Tensor:
    """Sort Gaussians by volume times opacity.

    Args:
        gaussians: of one subject.

    Returns:
        Indices [N] of the Gaussians, large and opaque ones first.
    """
    size = gaussians.scales.double().prod(-1) * gaussians.opacities
    return size.argsort(descending=True, stable=True)


def rgba(values: Mapping[str, Tensor]) -> Tensor:
    """Round colours and opacities to bytes.

    Args:
        values: those of :func:`ghgs_lit.ply.stored_values`.

    Returns:
        [N, 4] uint8.
    """
    colors = torch.cat([values["colors"], values["opacities"][:, None]], dim=-1)
    return (colors.clamp(0, 1) * 255).round().byte()
