"""Reading of ``annots.npy`` of a ZJU-MoCap sequence: its cameras and the names of its photographs.

A pickled dictionary in an array without dimensions: ``cams`` with lists ``K`` (3, 3), ``D`` (4 or 5
coefficients in any shape), ``R`` (3, 3), ``T`` (3, 1) in **millimetres**, world to camera; ``ims``
with a dictionary for each frame, whose ``ims`` are the paths of its photographs in the order of the
cameras. In sequences 313 and 315 these are the original long names, whose fifth field is the frame
number from 1.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

import numpy as np

from ghgs_lit.data.decoding import check_array, check_extrinsics, check_intrinsics
from ghgs_lit.data.pickles import load_npy
from ghgs_lit.errors import InputError

MILLIMETRES = 1000.0
# Metres: cameras that are closer together were not given in millimetres.
_NEAREST = 0.1


@dataclass(frozen=True)
class Annotations:
    """Cameras of a sequence and its photographs.

    Attributes:
        intrinsics: [n, 3, 3] in pixels, with pixel centres at integers.
        distortions: k1 k2 p1 p2 (k3) of each camera.
        extrinsics: [n, 4, 4], world to camera, metres.
        frames: ``frames[f][k]`` is the path of camera k at frame f.
    """

    intrinsics: np.ndarray
    distortions: tuple[np.ndarray, ...]
    extrinsics: np.ndarray
    frames: tuple[tuple[PurePosixPath, ...], ...]


def read_annotations(path: Path) -> Annotations:
    """Read and check an ``annots.npy``.

    Args:
        path: of the file.

    Raises:
        InputError: it is missing, unsafe or broken, or an entry is bad.
    """
    content = load_npy(path)
    cams = _entry(path, content, "cams")
    ims = _entry(path, content, "ims")
    lists = {key: _entry(f"{path}: cams", cams, key) for key in ("K", "D", "R", "T")}
    counts = {key: len(values) for key, values in lists.items()}
    if len(set(counts.values())) != 1 or not counts["K"]:
        raise InputError(f"{path}: expected as many K, D, R and T in cams as cameras; found {counts}")
    poses = enumerate(zip(lists["R"], lists["T"], strict=True))
    extrinsics = np.stack([_extrinsics(f"{path}: camera {k}", *pose) for k, pose in poses])
    centers = -np.einsum("nji,nj->ni", extrinsics[:, :3, :3], extrinsics[:, :3, 3])
    spread = np.linalg.norm(centers - centers[0], axis=-1).max()
    if len(centers) > 1 and spread < _NEAREST:
        raise InputError(
            f"{path}: expected translations T in millimetres; found cameras within "
            f"{spread * 1000:.0f} mm of one another (metres?)"
        )
    lenses = [check_intrinsics(f"{path}: K of camera {k}", m) for k, m in enumerate(lists["K"])]
    return Annotations(
        intrinsics=np.stack(lenses),
        distortions=tuple(_distortion(f"{path}: D of camera {k}", d) for k, d in enumerate(lists["D"])),
        extrinsics=extrinsics,
        frames=tuple(_frame(path, f, entry, counts["K"]) for f, entry in enumerate(ims)),
    )


def frame_number(name: PurePath) -> int:
    """Frame number in a photograph's name; files of bodies are named after it.

    Args:
        name: path of the photograph.

    Raises:
        InputError: there is none.
    """
    field = frame_field(name)
    if not field.isdecimal():
        raise InputError(
            f"{name}: expected a frame number, or a name whose fifth field is one; found {name.name!r}"
        )
    return int(field)


def frame_field(name: PurePath) -> str:
    """Frame number as written in a name: ``000012``,
    or ``0001`` of ``…_Camera_(1)_0001_2019-…``."""
    fields = name.stem.split("_")
    return fields[4] if len(fields) > 4 else name.stem


def _entry(place: Path | str, content: Any, key: str) -> Any:
    entry = content.get(key) if isinstance(content, Mapping) else None
    if entry is None or not isinstance(entry, (Mapping, Sequence, np.ndarray)):
        known = sorted(map(str, content)) if isinstance(content, Mapping) else type(content).__name__
        raise InputError(f"{place}: expected an entry {key!r}; found {known}")
    return entry


def _extrinsics(place: str, rotation: Any, translation: Any) -> np.ndarray:
    rotation = check_array(f"{place}: R", rotation, [(3, 3)])
    translation = check_array(f"{place}: T", translation, [(3, 1), (3,), (1, 3)]).reshape(3, 1) / MILLIMETRES
    return check_extrinsics(place, np.concatenate((rotation, translation), 1))


def _distortion(place: str, coefficients: Any) -> np.ndarray:
    flat = check_array(place, np.ravel(coefficients), [(4,), (5,)])
    if np.abs(flat).max() > 10:
        raise InputError(f"{place}: expected lens coefficients k1 k2 p1 p2 (k3); found {flat.tolist()}")
    return flat


def _frame(path: Path, index: int, entry: Any, cameras: int) -> tuple[PurePosixPath, ...]:
    """Paths of the photographs of a frame, in the order of the cameras.

    Args:
        path: of the annotations, for messages.
        index: of the frame, for messages.
        entry: of the frame in ``ims``.
        cameras: number of cameras.

    Raises:
        InputError: paths are missing, leave the sequence, or have different frame numbers.
    """
    names = _entry(f"{path}: frame {index}", entry, "ims")
    if len(names) != cameras:
        raise InputError(
            f"{path}: frame {index}: expected a photograph for each of {cameras} cameras; found {len(names)}"
        )
    photographs = tuple(PurePosixPath(str(name).replace("\\", "/")) for name in names)
    for name in photographs:
        if name.is_absolute() or ".." in name.parts:
            raise InputError(f"{path}: frame {index}: expected paths below the sequence; found {str(name)!r}")
    numbers = {frame_field(name) for name in photographs}
    if len(numbers) != 1:
        raise InputError(
            f"{path}: frame {index}: expected one frame number for all cameras; found {sorted(numbers)[:3]}"
        )
    return photographs
