"""Write the files of a rendered subject in the layout of :mod:`ghgs_lit.data.layout`."""

from pathlib import Path

import numpy as np
from PIL import Image

from ghgs_lit.data.view import View

# zlib's Z_RLE: half the time of the default, with files no larger
_PNG = {"compress_type": 3}


def write_view(phase: Path, folder: str, number: int, view: View, quality: int = 98) -> None:
    """Write one view of a subject.

    The JPEG has full chroma resolution. The mask has three equal channels, of which the authors' loader
    reads the first.

    Args:
        phase: folder of the phase, or a workspace.
        folder: name of the subject's position, ``<id>_<position>``.
        number: number of the view at its position.
        view: image, mask and camera; matte and inverse depth are optional.
        quality: quality of the JPEG, 1 to 100.
    """
    folders = {kind: phase / kind / folder for kind in ("img", "mask", "alpha", "depth", "parm")}
    for path in folders.values():
        path.mkdir(parents=True, exist_ok=True)
    Image.fromarray(view.image).save(folders["img"] / f"{number}.jpg", quality=quality, subsampling=0)
    mask = np.repeat(view.mask[..., None].astype(np.uint8) * 255, 3, axis=-1)
    Image.fromarray(mask).save(folders["mask"] / f"{number}.png", **_PNG)
    if view.matte is not None:
        Image.fromarray(view.matte).save(folders["alpha"] / f"{number}.png", **_PNG)
    if view.inverse_depth is not None:
        Image.fromarray(view.inverse_depth).save(folders["depth"] / f"{number}.png", **_PNG)
    np.save(folders["parm"] / f"{number}_intrinsic.npy", view.intrinsics.astype(np.float64))
    np.save(folders["parm"] / f"{number}_extrinsic.npy", view.extrinsics[:3].astype(np.float64))


def write_body(phase: Path, name: str, vertices: np.ndarray) -> None:
    """Write the vertices of a subject's body.

    Args:
        phase: folder of the phase, or a workspace.
        name: name of the subject.
        vertices: [n, 3], metres.
    """
    folder = phase / "smpl" / name
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "vertices.npy", vertices.astype(np.float32))
