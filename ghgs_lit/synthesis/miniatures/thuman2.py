"""A small THuman2.0 of built-in people: raw scans with fits, or renders as the published scripts make them.

Names, types, shapes and units are those of the real files (:mod:`ghgs_lit.synthesis.thuman2_scans`,
:mod:`ghgs_lit.data.layout`). Bodies are MakeHuman's in place of SMPL-X: the parameters in
``smplx_param.pkl`` have the right shapes and place the body correctly, but do not pose it.
"""

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation
from trimesh.caching import TrackedArray

from ghgs_lit.data.layout import position_name
from ghgs_lit.data.sampling import VIEW_NUMBERS, subject_rng
from ghgs_lit.errors import require
from ghgs_lit.synthesis import people
from ghgs_lit.synthesis.miniatures.capture import save_image
from ghgs_lit.synthesis.people.generate import join
from ghgs_lit.synthesis.people.mesh import Person, TexturedMesh
from ghgs_lit.synthesis.photograph import Lights, Studio
from ghgs_lit.synthesis.rig import Rig
from ghgs_lit.types import Cameras

FIT_FOLDER = "THuman2.0_smplx"
# Id of the first scan of each phase.
FIRST = {"train": 0, "val": 426}
POSE_SIZES = {
    "betas": 10,
    "body_pose": 63,
    "left_hand_pose": 12,
    "right_hand_pose": 12,
    "jaw_pose": 3,
    "leye_pose": 3,
    "reye_pose": 3,
    "expression": 10,
}


def names(people: Mapping[str, int]) -> dict[str, list[str]]:
    """Ids of each phase: ``0000`` on for training, ``0426`` on for validation."""
    for phase, count in people.items():
        limit = 426 if phase == "train" else 100
        require(0 <= count <= limit, f"miniature.people.{phase}", f"between 0 and {limit}", count)
    return {phase: [f"{FIRST[phase] + i:04d}" for i in range(count)] for phase, count in people.items()}


@dataclass(frozen=True)
class _Scan:
    """A person as one mesh in a scan's frame, with the fit that maps the body to it."""

    mesh: TexturedMesh
    body: np.ndarray
    yaw: float
    scale: float
    translation: np.ndarray


@lru_cache(maxsize=4)
def _scan(name: str, seed: int) -> _Scan:
    """Person number ``int(name)``, turned by a random yaw, in units that are not metres."""
    person = people.generate(seed, int(name))
    rng = subject_rng(seed, name)
    yaw = float(rng.uniform(-np.pi, np.pi))
    scale, translation = float(rng.uniform(0.5, 0.9)), rng.uniform(-0.3, 0.3, 3)
    turn = Rotation.from_euler("y", yaw).as_matrix().T

    def place(vertices: np.ndarray) -> np.ndarray:
        return (vertices.astype(np.float64) @ turn) * scale + translation

    mesh = join(list(person.parts))
    moved = replace(mesh, vertices=place(mesh.vertices).astype(np.float32))
    return _Scan(moved, place(person.body_vertices), yaw, scale, translation)


def make_raw(source: Path, people: Mapping[str, int], size: int, seed: int) -> Path:
    """Write scans below ``source``, their fits into a folder beside it, and the split files.

    Args:
        source: folder of the scans.
        people: how many, ``{train: n, val: n}``.
        size: textures are scaled down to at most twice as many pixels a side.
        seed: of people and their placement.

    Returns:
        ``source``.
    """
    listed = names(people)
    for name in (name for phase in listed.values() for name in phase):
        scan = _scan(name, seed)
        _write_obj(source / name, name, scan.mesh, 2 * size)
        _write_fit(fit_folder(source) / name, scan, subject_rng(seed + 1, name))
    for phase, phase_names in listed.items():
        (source / f"split_{phase}.txt").write_text("".join(f"{name}\n" for name in phase_names))
    return source


def fit_folder(source: Path) -> Path:
    """The folder of the fits, beside the scans in ``source``."""
    return source.parent / FIT_FOLDER


def _write_obj(folder: Path, name: str, mesh: TexturedMesh, texture_size: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["mtllib material0.mtl", "usemtl material0"]
    lines += [*_obj_lines("v", mesh.vertices), *_obj_lines("vt", mesh.uv)]
    lines += ["f " + " ".join(f"{i}/{i}" for i in face) for face in mesh.faces + 1]
    (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")
    (folder / "material0.mtl").write_text("newmtl material0\nmap_Kd material0.jpeg\n")
    texture = Image.fromarray(mesh.texture)
    texture.thumbnail((texture_size, texture_size), Image.Resampling.BOX)
    save_image(folder / "material0.jpeg", texture)


def _obj_lines(keyword: str, rows: np.ndarray) -> list[str]:
    return [" ".join((keyword, *(f"{number:.6f}" for number in row))) for row in rows]


def _write_fit(folder: Path, scan: _Scan, rng: np.random.Generator) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    fit = {name: rng.normal(0, 0.1, (1, n)).astype(np.float32) for name, n in POSE_SIZES.items()}
    fit["global_orient"] = np.array([[0, scan.yaw, 0]], np.float32)
    fit["scale"] = np.float32(scan.scale)
    fit["translation"] = scan.translation.astype(np.float32).view(TrackedArray)
    with (folder / "smplx_param.pkl").open("wb") as stream:
        pickle.dump(fit, stream)
    (folder / "mesh_smplx.obj").write_text("\n".join(_obj_lines("v", scan.body)) + "\n")


def make(
    root: Path,
    people: Mapping[str, int],
    size: int,
    seed: int,
    vids: Sequence[int] = VIEW_NUMBERS,
    positions: int = 16,
) -> Path:
    """Write renders below ``root`` in the layout that the published scripts make.

    In it pixel centres are at integers, the principal point is 25/1024 of the side below the middle, masks
    have three channels, inverse depth is truncated (not rounded) to 16 bits, extrinsics are 3 x 4, the views
    between cameras also have photographs of twice the size (``<view>_hr.jpg``), and bodies lie in ``smpl``
    with their normals.

    Args:
        root: folder of the phases.
        people: how many, ``{train: n, val: n}``.
        size: side of the square photographs in pixels.
        seed: of people, cameras and lights.
        vids: the views at each position.
        positions: how many around the subject.

    Returns:
        ``root``.
    """
    rig = Rig(positions=positions)
    for phase, listed in names(people).items():
        for name in listed:
            rng = subject_rng(seed, name)
            scan = _scan(name, seed)
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
