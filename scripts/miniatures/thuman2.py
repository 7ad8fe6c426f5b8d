"""A small THuman2.0 of built-in people, rendered as by the published scripts.

Names, types, shapes and units are those of the real files (:mod:`ghgs_lit.data.layout`); people are
those of :mod:`scripts.miniatures.scans`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
from PIL import Image

from ghgs_lit.data.layout import position_name
from ghgs_lit.data.sampling import ViewNumber, subject_rng
from ghgs_lit.types import Cameras
from ghgs_people.figures.mesh import Person
from ghgs_people.lights import Lights
from ghgs_people.photograph import Studio
from ghgs_people.rig import Rig
from scripts.miniatures.capture import save_image
from scripts.miniatures.scans import names, scan_of


def make(
    root: Path,
    people: Mapping[str, int],
    size: int,
    seed: int,
    vids: Sequence[int] = get_args(ViewNumber),
    positions: int = 16,
) -> Path:
    """Write renders below ``root`` in the layout of the published scripts.

    Pixel centres are at integers, the principal point is 25/1024 of the side below the middle, masks
    have three channels, inverse depth is truncated (not rounded) to 16 bits, extrinsics are 3 x 4,
    the views between cameras also have photographs of twice the size (``<view>_hr.jpg``), and bodies
    are in ``smpl`` with their normals.

    Args:
        root: folder of the phases.
        people: numbers of people, ``{train: n, val: n}``.
        size: side of the square photographs in pixels.
        seed: of people, cameras and lights.
        vids: the views at each position.
        positions: number of positions around the subject.

    Returns:
        ``root``.
    """
    rig = Rig(positions=positions)
    for phase, listed in names(people).items():
        for name in listed:
            rng = subject_rng(seed, name)
            scan = scan_of(name, seed)
            person = rig.place(Person(name, (scan.mesh,), scan.body.astype(np.float32)), rng)
            studio = Studio(person, Lights().draw(rng), samples=2)
            yaws = rig.yaws(rng) + np.degrees(scan.yaw)
            for position in range(positions):
                cameras = rig.cameras(yaws[position, list(vids)], size, size)
                _write_position(root / phase, position_name(name, position), studio, cameras, vids)
            _write_body(root / phase / "smpl" / name, person.body_vertices, rng)
    return root


def _write_position(
    phase: Path, position: str, studio: Studio, cameras: Cameras, vids: Sequence[int]
) -> None:
    """Write the views of one position."""
    img, mask, depth, parm = (phase / kind / position for kind in ("img", "mask", "depth", "parm"))
    parm.mkdir(parents=True, exist_ok=True)
    # The published renderer puts pixel centres at integers, this package at half pixels.
    half = cameras.intrinsics.clone()
    half[:, :2, 2] += 0.5
    photographs = studio.shoot(replace(cameras, intrinsics=half))
    for n, vid in enumerate(vids):
        image = np.round(photographs.images[n] * 255).astype(np.uint8)
        save_image(img / f"{vid}.jpg", image)
        save_image(mask / f"{vid}.png", np.repeat(photographs.masks[n][..., None] * np.uint8(255), 3, -1))
        z = photographs.depths[n]
        inverse = np.where(z > 0, 2.0**15 / np.where(z > 0, z, 1), 0).astype(np.uint16)
        save_image(depth / f"{vid}.png", inverse)
        np.save(parm / f"{vid}_intrinsic.npy", cameras.intrinsics[n].double().numpy())
        np.save(parm / f"{vid}_extrinsic.npy", cameras.extrinsics[n, :3].double().numpy())
        if vid >= 2:
            large = Image.fromarray(image).resize((2 * cameras.width, 2 * cameras.height))
            save_image(img / f"{vid}_hr.jpg", large, quality=75)


def _write_body(folder: Path, vertices: np.ndarray, rng: np.random.Generator) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "vertices.npy", vertices.astype(np.float32))
    np.save(folder / "normal.npy", rng.normal(size=vertices.shape).astype(np.float32))
    np.save(folder / "param.npy", {"Rh": np.zeros((1, 3), np.float32), "Th": np.zeros((1, 3), np.float32)})
