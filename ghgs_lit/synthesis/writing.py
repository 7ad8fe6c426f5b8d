"""Writes views and bodies in the layout that :mod:`ghgs_lit.data.layout` reads."""

from pathlib import Path

import numpy as np
from PIL import Image

from ghgs_lit.data.view import View


def write_view(phase: Path, folder: str, number: int, view: View, quality: int | None = 98) -> None:
    """Write one view; the JPEG keeps the full resolution of colours.

    The mask has three equal channels: the authors' loader takes channel 0 of an image that has several.
    ``folder``: name of the subject's position, ``<id>_<position>``. ``quality``: of the JPEG, 1 to 100; None:
    a PNG, without loss.
    """
    folders = {kind: phase / kind / folder for kind in ("img", "mask", "alpha", "depth", "parm")}
    for path in folders.values():
        path.mkdir(parents=True, exist_ok=True)
    path, lossy = folders["img"] / f"{number}.jpg", {"quality": quality, "subsampling": 0}
    Image.fromarray(view.image).save(path.with_suffix(".png") if quality is None else path, **lossy)
    mask = np.repeat(view.mask[..., None].astype(np.uint8) * 255, 3, axis=-1)
    Image.fromarray(mask).save(folders["mask"] / f"{number}.png")
    if view.matte is not None:
        Image.fromarray(view.matte).save(folders["alpha"] / f"{number}.png")
    if view.inverse_depth is not None:
        Image.fromarray(view.inverse_depth).save(folders["depth"] / f"{number}.png")
    np.save(folders["parm"] / f"{number}_intrinsic.npy", view.intrinsics.astype(np.float64))
    np.save(folders["parm"] / f"{number}_extrinsic.npy", view.extrinsics[:3].astype(np.float64))


def write_body(phase: Path, name: str, vertices: np.ndarray, kind: str = "smpl") -> None:
    """Write the vertices [n, 3] of a subject's body, or of another ``kind``: ``surface``."""
    folder = phase / kind / name
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "vertices.npy", vertices.astype(np.float32))
