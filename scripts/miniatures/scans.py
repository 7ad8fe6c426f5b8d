"""Built-in people as scans of THuman2.0, with their fits.

Names, types, shapes and units are those of the real files (:mod:`ghgs_people.thuman2`). Bodies are
MakeHuman's instead of SMPL-X's: the parameters in ``smplx_param.pkl`` have the right shapes and place
the body correctly, but do not pose it. Written folders are marked, so that real data of the same
names is never overwritten.
"""

import pickle
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation
from trimesh.caching import TrackedArray

from ghgs_lit.data.sampling import subject_rng
from ghgs_lit.errors import InputError, require
from ghgs_people import figures
from ghgs_people.figures.generate import join
from ghgs_people.figures.mesh import TexturedMesh
from ghgs_people.thuman2 import FIT_FOLDERS

#: Name of the file that marks folders of miniatures.
MARKER = "miniature"
# Id of the first scan of each phase.
_FIRST = {"train": 0, "val": 426}
POSE_SIZES = {"betas": 10, "body_pose": 63, "left_hand_pose": 12, "right_hand_pose": 12, "jaw_pose": 3}
POSE_SIZES |= {"leye_pose": 3, "reye_pose": 3, "expression": 10}


def mark(*folders: Path) -> None:
    """Mark folders as a miniature's before they are written.

    Raises:
        InputError: a folder has files but no mark.
    """
    for folder in folders:
        marked = (folder / MARKER).is_file() or not folder.is_dir()
        found = [] if marked else sorted(path.name for path in folder.iterdir())
        if found:
            raise InputError(
                f"{folder}: expected an empty folder or a miniature; found files such as {found[0]}"
            )
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / MARKER).touch()


def fit_folder(source: Path) -> Path:
    """The folder of the fits, next to ``source``."""
    return source.parent / FIT_FOLDERS[0]


def names(people_of: Mapping[str, int]) -> dict[str, list[str]]:
    """Ids of each phase: from ``0000`` for training, from ``0426`` for validation."""
    for phase, count in people_of.items():
        limit = 426 if phase == "train" else 100
        require(0 <= count <= limit, f"--{phase}", f"between 0 and {limit}", count)
    return {phase: [f"{_FIRST[phase] + i:04d}" for i in range(count)] for phase, count in people_of.items()}


@dataclass(frozen=True)
class Scan:
    """A person as one mesh in a scan's frame, with the fit that maps the body [n, 3] to it; yaw in
    radians."""

    mesh: TexturedMesh
    body: np.ndarray
    yaw: float
    scale: float
    translation: np.ndarray


@lru_cache(maxsize=4)
def scan_of(name: str, seed: int) -> Scan:
    """Person number ``int(name)``, rotated by a random yaw, in units other than metres."""
    person = figures.generate(seed, int(name))
    rng = subject_rng(seed, name)
    yaw = float(rng.uniform(-np.pi, np.pi))
    scale, translation = float(rng.uniform(0.5, 0.9)), rng.uniform(-0.3, 0.3, 3)
    turn = Rotation.from_euler("y", yaw).as_matrix().T

    def place(vertices: np.ndarray) -> np.ndarray:
        return (vertices.astype(np.float64) @ turn) * scale + translation

    mesh = join(list(person.parts))
    moved = replace(mesh, vertices=place(mesh.vertices).astype(np.float32))
    return Scan(moved, place(person.body_vertices), yaw, scale, translation)


def make_scans(source: Path, people_of: Mapping[str, int], size: int, seed: int) -> Path:
    """Write scans and split files into ``source``, and their fits next to it; return ``source``.

    Args:
        people_of: numbers of scans, ``{train: n, val: n}``.
        size: textures are downsampled to at most ``2 * size`` pixels a side.
    """
    listed = names(people_of)
    for name in (name for phase in listed.values() for name in phase):
        scan = scan_of(name, seed)
        _write_obj(source / name, name, scan.mesh, 2 * size)
        _write_fit(fit_folder(source) / name, scan, subject_rng(seed + 1, name))
    for phase, phase_names in listed.items():
        (source / f"split_{phase}.txt").write_text("".join(f"{name}\n" for name in phase_names))
    return source


def _write_obj(folder: Path, name: str, mesh: TexturedMesh, texture_size: int) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["mtllib material0.mtl", "usemtl material0"]
    lines += [*_obj_lines("v", mesh.vertices), *_obj_lines("vt", mesh.uv)]
    lines += ["f " + " ".join(f"{i}/{i}" for i in face) for face in mesh.faces + 1]
    (folder / f"{name}.obj").write_text("\n".join(lines) + "\n")
    (folder / "material0.mtl").write_text("newmtl material0\nmap_Kd material0.jpeg\n")
    texture = Image.fromarray(mesh.texture)
    texture.thumbnail((texture_size, texture_size), Image.Resampling.BOX)
    texture.save(folder / "material0.jpeg", quality=95)


def _obj_lines(keyword: str, rows: np.ndarray) -> list[str]:
    return [" ".join((keyword, *(f"{number:.6f}" for number in row))) for row in rows]


def _write_fit(folder: Path, scan: Scan, rng: np.random.Generator) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    fit = {name: rng.normal(0, 0.1, (1, n)).astype(np.float32) for name, n in POSE_SIZES.items()}
    fit["global_orient"] = np.array([[0, scan.yaw, 0]], np.float32)
    fit["scale"] = np.float32(scan.scale)
    fit["translation"] = scan.translation.astype(np.float32).view(TrackedArray)
    with (folder / "smplx_param.pkl").open("wb") as stream:
        pickle.dump(fit, stream)
    (folder / "mesh_smplx.obj").write_text("\n".join(_obj_lines("v", scan.body)) + "\n")
