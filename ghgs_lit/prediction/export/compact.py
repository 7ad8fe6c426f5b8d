"""Gaussians in the compact formats of 3DGS viewers, which the package gaussforge makes from the PLY.

They store few bits: ``docs/evidence/outputs.md`` has their sizes and what is lost.
"""

from pathlib import Path

from ghgs_lit.files import write_atomically

FORMATS = {"compressed_ply": "compressed.ply", "spz": "spz", "sog": "sog"}
"""What gaussforge, and the suffix of files, calls each format."""


def write_compact(ply: bytes, path: Path, name: str) -> None:
    """Write a PLY of Gaussians in another format.

    Args:
        ply: the content of a file of :func:`ghgs_lit.prediction.export.ply.write_ply`.
        path: the file to write.
        name: one of ``FORMATS``.

    Raises:
        RuntimeError: gaussforge refuses.
    """
    from gaussforge import GaussForge

    answer = GaussForge().convert(ply, "ply", FORMATS[name])
    if answer.get("error"):
        raise RuntimeError(f"{path}: gaussforge: {answer['error']}")
    write_atomically(path, lambda temporary: temporary.write_bytes(answer["data"]))
