"""Gaussians as PLY files for viewers of 3D Gaussian Splatting.

Positions are in metres in the world frame; opacities are stored as logits, standard deviations as
logarithms, rotations as unit quaternions ``(w, x, y, z)``, colours as the constant term of spherical
harmonics. A comment in the header has the renderer settings (low-pass filter, antialiasing) that the
Gaussians were made for; other programs ignore it. It follows the ``element`` line, because 3D
Gaussian Splatting's own viewer takes the third line of the file for that one.
"""

import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor

from ghgs_lit.errors import InputError, require
from ghgs_lit.files import write_atomically
from ghgs_lit.types import Gaussians

SH_CONSTANT = 0.5 / np.sqrt(np.pi)
"""Value of the constant spherical harmonic: colour = 0.5 + SH_CONSTANT * f_dc."""
_CONSTANTS = "ghgs_lit low_pass={low_pass!r} antialiased={antialiased}"
_CONSTANTS_PATTERN = re.compile(r"ghgs_lit low_pass=(\S+) antialiased=(True|False)")
_OPACITY_LIMIT = 1e-6  # logits of 0 and 1 are infinite
_SMALLEST_SCALE = 1e-9  # metres
_GROUPS = {
    "means": ("x", "y", "z"),
    "normals": ("nx", "ny", "nz"),
    "colors": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacities": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quaternions": ("rot_0", "rot_1", "rot_2", "rot_3"),
}


def write_ply(gaussians: Gaussians, path: str | Path) -> None:
    """Write the Gaussians of one subject, atomically.

    Args:
        gaussians: of one subject, with RGB colours.
        path: of the file.

    Raises:
        InputError: several subjects, or other colours.
    """
    data = ply_bytes(gaussians)
    write_atomically(path, lambda temporary: temporary.write_bytes(data))


def ply_bytes(gaussians: Gaussians) -> bytes:
    """Content of the file that :func:`write_ply` writes.

    The format is that of 3D Gaussian Splatting (Kerbl et al., SIGGRAPH 2023).

    Args:
        gaussians: of one subject, with RGB colours.

    Returns:
        A binary PLY.

    Raises:
        InputError: several subjects, or other colours.
    """
    require(len(gaussians.splits) == 1, "write_ply", "the Gaussians of one subject", len(gaussians.splits))
    channels = gaussians.colors.shape[1]
    require(channels == 3, "write_ply", "colours of 3 channels", channels)
    values = stored_values(gaussians, torch.float64)
    opacities = values["opacities"].clamp(_OPACITY_LIMIT, 1 - _OPACITY_LIMIT)
    values |= {
        "normals": torch.zeros_like(values["means"]),
        "colors": (values["colors"] - 0.5) / SH_CONSTANT,
        "opacities": torch.logit(opacities)[:, None],
        "scales": values["scales"].clamp(min=_SMALLEST_SCALE).log(),
    }
    columns = {}
    for group, names in _GROUPS.items():
        for i, name in enumerate(names):
            columns[name] = values[group][:, i].numpy().astype("<f4")
    low_pass = float(gaussians.low_pass)
    antialiased = bool(gaussians.antialiased)
    return vertices_ply(columns, [_CONSTANTS.format(low_pass=low_pass, antialiased=antialiased)])


def stored_values(gaussians: Gaussians, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    """Values of Gaussians as written to files.

    Args:
        gaussians: of any number of subjects.
        dtype: of the result.

    Returns:
        Means, scales, unit quaternions, opacities and colours on the CPU, by field name.
    """
    names = ("means", "scales", "quaternions", "opacities", "colors")
    values = {name: getattr(gaussians, name).detach().to("cpu", dtype) for name in names}
    return values | {"quaternions": torch.nn.functional.normalize(values["quaternions"], dim=-1)}


def vertices_ply(columns: Mapping[str, np.ndarray], comments: Sequence[str] = ()) -> bytes:
    """Content of a binary PLY with one vertex per row.

    Args:
        columns: values [N] of each property, by name.
        comments: lines of the header, written below the ``element`` line.

    Returns:
        A little-endian binary PLY.
    """
    vertices = np.rec.fromarrays(list(columns.values()), names=list(columns))
    content = BytesIO()
    elements = [PlyElement.describe(np.asarray(vertices), "vertex", comments=list(comments))]
    PlyData(elements, byte_order="<").write(content)
    return content.getvalue()


def _read(path: Path) -> PlyData:
    """Read a PLY, also with comments that are not ASCII, which some programs write."""
    try:
        return PlyData.read(path)
    except UnicodeDecodeError:
        header, end, body = path.read_bytes().partition(b"end_header")
        return PlyData.read(BytesIO(bytes(min(byte, 127) for byte in header) + end + body))


def read_ply(path: Path) -> Gaussians:
    """Read a 3DGS PLY as the Gaussians of one subject, without view-dependent colours.

    A file without this package's comment is read as made for the renderer of 3D Gaussian Splatting: a
    low-pass filter of 0.3 px^2, not antialiased.

    Args:
        path: of the file.

    Returns:
        The Gaussians, float32, on the CPU.

    Raises:
        InputError: the file is not a 3DGS PLY.
    """
    try:
        content = _read(path)
        vertices = content["vertex"]
        columns = {}
        for group, names in _GROUPS.items():
            if group != "normals":
                numbers = [np.asarray(vertices[name], np.float32) for name in names]
                columns[group] = torch.from_numpy(np.stack(numbers, -1))
        comments = [*vertices.comments, *content.comments]
        matches = filter(None, map(_CONSTANTS_PATTERN.fullmatch, comments))
        constants = [{"low_pass": float(m[1]), "antialiased": m[2] == "True"} for m in matches]
    except (PlyParseError, KeyError, ValueError, MemoryError, OverflowError) as error:
        raise InputError(f"{path}: expected a 3D Gaussian Splatting PLY; found {error}") from error
    return Gaussians(
        means=columns["means"],
        quaternions=columns["quaternions"],
        scales=columns["scales"].exp(),
        opacities=columns["opacities"][:, 0].sigmoid(),
        colors=columns["colors"] * SH_CONSTANT + 0.5,
        splits=(len(columns["means"]),),
        **(constants[0] if constants else {}),
    )
