"""Gaussians in the compact formats of 3DGS viewers;
``docs/evidence/outputs.md`` has sizes and losses."""

from dataclasses import replace

from ghgs_lit.errors import InputError
from ghgs_lit.ply import ply_bytes
from ghgs_lit.types import Gaussians

CONVERTED = {"compressed_ply": "compressed.ply", "spz": "spz", "sog": "sog"}
"""Formats that the package gaussforge makes from a PLY;
what it, and the suffix of files, calls each."""


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
