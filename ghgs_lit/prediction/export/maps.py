"""Depth maps, photographs, cameras and point clouds as files of common formats."""

import json
from pathlib import Path

import numpy as np
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from plyfile import PlyData, PlyElement

from ghgs_lit.files import write_atomically, write_text_atomically
from ghgs_lit.geometry.mattes import unmultiplied
from ghgs_lit.prediction.export.scene import Scene, file_name
from ghgs_lit.visualization.pictures import to_uint8

_LEVELS = 65535  # of a picture of 16 bits


def depth_unit(largest: float) -> float:
    """The length of one grey level of a depth picture: 0.001, and other powers of ten where these fit better.

    So that ``largest`` fits into 16 bits and has at least 1000 levels.
    """
    exponent = -3
    while largest > _LEVELS * 10.0**exponent:
        exponent += 1
    while 0 < largest < 1000 * 10.0**exponent:
        exponent -= 1
    return 10.0**exponent


def write_depths(scene: Scene, directory: Path) -> list[Path]:
    """``depth/<view>.png`` (16 bits, 0: none; the unit stands in the file) and ``depth.npz`` (exact).

    The NPZ has ``depth`` [V, H, W] (nan: none), ``intrinsics``, ``extrinsics`` and ``views``.
    """
    valid = scene.depth_valid.cpu().numpy()
    depth = np.where(valid, scene.depth.float().cpu().numpy(), np.float32(np.nan))
    unit = depth_unit(float(np.max(depth, where=valid, initial=0)))
    text = PngInfo()
    text.add_text("Unit", f"{unit:g} (length of one grey level; 0: no depth)")
    paths = [directory / "depth" / f"{file_name(view)}.png" for view in scene.views]
    for path, values in zip(paths, depth, strict=True):
        levels = np.nan_to_num(np.round(values / unit)).astype(np.uint16)
        write_atomically(path, lambda p, a=levels: Image.fromarray(a).save(p, format="PNG", pnginfo=text))
    path = directory / "depth.npz"
    arrays = {
        "depth": depth,
        "intrinsics": scene.cameras.intrinsics.cpu().numpy(),
        "extrinsics": scene.cameras.extrinsics.cpu().numpy(),
        "views": np.array(scene.views),
    }

    def save(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez_compressed(file, **arrays)

    write_atomically(path, save)
    return [*paths, path]


def write_points(scene: Scene, directory: Path) -> list[Path]:
    """``points.ply``: the unprojected pixels of the subject with their colours."""
    names = [(axis, "<f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    vertices = np.empty(len(scene.points), dtype=names)
    positions = scene.points.float().cpu().numpy()
    colors = (scene.colors.float().clamp(0, 1) * 255).round().byte().cpu().numpy()
    for i in range(3):
        vertices[names[i][0]], vertices[names[3 + i][0]] = positions[:, i], colors[:, i]
    path = directory / "points.ply"
    write_atomically(path, PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write)
    return [path]


def write_inputs(scene: Scene, directory: Path) -> list[Path]:
    """``inputs/<view>.png``, what the model saw with its matte or mask as alpha, and ``cameras.json``.

    Both are what ``ghgs predict images=inputs cameras=cameras.json`` reads.
    """
    paths = [directory / "inputs" / f"{file_name(view)}.png" for view in scene.views]
    for path, image, matte in zip(paths, scene.images, scene.mattes, strict=True):
        # Colours of a PNG are not premultiplied.
        colors = to_uint8(unmultiplied(image, matte))
        alpha = (matte * 255).round().byte().cpu().numpy()[..., None]
        picture = Image.fromarray(np.concatenate([colors, alpha], -1))
        write_atomically(path, lambda p, image=picture: image.save(p, format="PNG"))
    cameras = {
        path.stem: {
            "intrinsics": camera.intrinsics.tolist(),
            "extrinsics": camera.extrinsics.tolist(),
            "width": camera.width,
            "height": camera.height,
        }
        for path, camera in zip(paths, (scene.cameras[i] for i in range(len(paths))), strict=True)
    }
    path = directory / "cameras.json"
    write_text_atomically(path, json.dumps({"cameras": cameras}, indent=1))
    return [*paths, path]
