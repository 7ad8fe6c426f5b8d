"""A figure of ellipsoids in front of cameras, as photographs, masks and a calibration on disk."""

import functools
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from ghgs_lit.types import Cameras
from tests.helpers.cameras import camera_ring
from tests.helpers.scenes import ellipsoid

# Center and radii in metres: trunk, head, a raised and a hanging arm, two legs of different stance.
PARTS = (
    ((0.0, 1.05, 0.0), (0.2, 0.36, 0.14)),
    ((0.03, 1.58, 0.02), (0.1, 0.14, 0.11)),
    ((0.42, 1.36, 0.05), (0.27, 0.06, 0.06)),
    ((-0.27, 1.05, 0.1), (0.06, 0.3, 0.07)),
    ((0.12, 0.4, 0.1), (0.08, 0.4, 0.09)),
    ((-0.13, 0.42, -0.12), (0.08, 0.42, 0.09)),
)

#: Quarter turns that show a photograph upright, as for ``numpy.rot90``, by EXIF orientation.
TURNS = {3: 2, 6: 3, 8: 1}


@functools.cache
def _photographed(views, height, width, seed, jitter, focal):
    """Intrinsics, extrinsics, masks, photographs and backgrounds [views, ...] of the figure."""
    rng = np.random.default_rng(seed)
    place = {"center": (0, 0.9, 0), "raised": 0.4, "radius": 2.4, "start": 15.0}
    ring = camera_ring(views, height, width, 1, (focal * height,) * 2, **place)
    extrinsics = ring.extrinsics.double().numpy()[0]
    for pose in extrinsics:
        pose[:3] = _turned(rng.normal(0, jitter, 3)) @ pose[:3]
    cameras = Cameras(ring.intrinsics.double(), torch.from_numpy(extrinsics)[None], height, width)
    found = [ellipsoid(cameras, torch.tensor(c).double(), torch.tensor(r).double()) for c, r in PARTS]
    masks = np.stack([mask[0].numpy() for mask, _ in found]).any(0)
    background = rng.integers(90, 110, (views, height, width, 3)).astype(np.uint8)
    images = background.copy()
    for n, (mask, _) in enumerate(found):
        images[mask[0].numpy()] = [40 * n, 255 - 40 * n, 60 if n % 2 else 200]
    return ring.intrinsics[0].double().numpy(), extrinsics, masks, images, background


class Figure:
    """Photographs [v][h, w, 3] uint8, masks [v][h, w] bool and calibration of cameras around the figure."""

    def __init__(
        self, views=4, height=128, width=96, seed=0, jitter=0.0, focal=1.1, scale=1.0, origin=(0, 0, 0)
    ):
        intrinsics_of, extrinsics, masks, images, background = _photographed(
            views, height, width, seed, jitter, focal
        )
        self.masks, self.images, self.backgrounds = masks.copy(), images.copy(), background.copy()
        self.names = [f"cam{v}" for v in range(views)]
        self.cameras = {}
        for name, intrinsics, pose in zip(self.names, intrinsics_of, extrinsics, strict=True):
            world = pose.copy()
            world[:3, 3] = scale * pose[:3, 3] - pose[:3, :3] @ np.array(origin)
            self.cameras[name] = {
                "intrinsics": intrinsics.tolist(),
                "extrinsics": world.tolist(),
                "width": width,
                "height": height,
            }

    def write(self, folder: Path, masks: bool = True, cameras: Mapping[str, Any] | None = None) -> Path:
        """Write ``cam0.png``, ``cam0_mask.png`` and so on, and ``cameras.json``, whose path is returned."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, image, mask in zip(self.names, self.images, self.masks, strict=False):
            Image.fromarray(image).save(folder / f"{name}.png")
            if masks:
                Image.fromarray(mask).save(folder / f"{name}_mask.png")
        path = folder / "cameras.json"
        path.write_text(json.dumps({"cameras": self.cameras if cameras is None else cameras}))
        return path


def write_turned(path: Path, image: np.ndarray, orientation: int) -> None:
    """Write an upright photograph as phones do: in the sensor's orientation, which EXIF states."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(np.ascontiguousarray(np.rot90(image, -TURNS[orientation]))).save(path, exif=exif)


def camera_as_stored(camera: Mapping[str, Any], orientation: int) -> dict[str, Any]:
    """Camera of the stored pixels, from that of the upright photograph."""
    width, height = camera["width"], camera["height"]
    k, e = np.array(camera["intrinsics"]), np.array(camera["extrinsics"])
    for _ in range(TURNS[orientation]):  # back, clockwise: new x = height - old y, new y = old x
        k = np.array([[k[1, 1], 0, height - k[1, 2]], [0, k[0, 0], k[0, 2]], [0, 0, 1]])
        e = np.array([[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ e
        width, height = height, width
    return {"intrinsics": k.tolist(), "extrinsics": e.tolist(), "width": width, "height": height}


def _turned(angles: np.ndarray) -> np.ndarray:
    """Rotation about x by the first angle, then y by the second, then z by the third, in radians."""
    rotation = np.eye(3)
    for axis, angle in enumerate(angles):
        step, (i, j) = np.eye(3), [k for k in range(3) if k != axis]
        step[i, i] = step[j, j] = math.cos(angle)
        step[i, j], step[j, i] = -math.sin(angle), math.sin(angle)
        rotation = step @ rotation
    return rotation
