"""A small ZJU-MoCap of built-in people, with the names, dtypes, units and oddities of the real one.

Photographs are taken through distorting lenses in front of a grey wall. ``mask_cihp`` and ``mask``
both have holes; their union has none. ``vertices`` fits worse than ``new_vertices``. The parameters
of a body model (``params``, ``new_params``) have the right keys and shapes and a correct ``Rh`` and
``Th``; poses and shapes are zero, because the bodies are not SMPL's.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from kornia.geometry.calibration import undistort_points
from scipy.spatial.transform import Rotation

from ghgs_people import figures
from ghgs_people.figures.mesh import Person
from ghgs_people.lights import Lights
from ghgs_people.photograph import Studio
from scripts.miniatures import capture
from scripts.miniatures.smpl import chosen_vertices

# Sequences with long file names, frames numbered from 1, and two cameras fewer.
OLD = ("313", "315")
OLD_CAMERAS = (*range(1, 20), 22, 23)
NEW_CAMERAS = tuple(range(1, 24))
# Built-in people have y up, ZJU-MoCap has z up.
_Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
# Labels of the parsing model (hair, face, upper clothes, trousers, shoes) from top to bottom.
_LABELS = np.array([2, 13, 5, 5, 5, 9, 9, 9, 9, 18], np.uint8)


def make(root: Path, sequences: Sequence[str], size: int = 256, seed: int = 0, frames: int = 6) -> list[Path]:
    """Write sequences.

    Args:
        root: folder of the sequences.
        sequences: ids such as 377.
        size: side of the square photographs in pixels.
        seed: of people, cameras and lights.
        frames: number of frames per sequence.

    Returns:
        The folders of the sequences.
    """
    folders = []
    for index, sequence in enumerate(sequences):
        folder = root / f"CoreView_{sequence}"
        folder.mkdir(parents=True, exist_ok=True)
        _write_sequence(folder, sequence, figures.generate(seed, index), size, frames, [seed, index])
        folders.append(folder)
    return folders


def _write_sequence(
    folder: Path, sequence: str, person: Person, size: int, frames: int, seed: list[int]
) -> None:
    rng = np.random.default_rng(seed)
    old = sequence in OLD
    names = [f"Camera ({k})" for k in OLD_CAMERAS] if old else [f"Camera_B{k}" for k in NEW_CAMERAS]
    stage = np.array([0.4, 0.1, -0.3])  # people stand away from the world's origin
    matrices, lenses, poses = _calibration(len(names), size, stage, rng)
    grids = [_distorting_grid(matrix, lens, size) for matrix, lens in zip(matrices, lenses, strict=True)]
    lights = Lights().draw(rng)
    listed = []
    for frame in range(frames):
        stem = _long_stem if old else _short_stem
        photographs = [f"{name}/{stem(sequence, name, frame)}.jpg" for name in names]
        listed.append({"ims": photographs})
        # The person turns and takes small steps.
        step = np.array([0.06 * np.sin(frame), 0, 0.06 * np.cos(2 * frame)])
        pose = _Z_UP @ capture.rigid_transform(35.0 * frame, stage + step)
        posed = capture.move_person(person, pose)
        _write_body(folder, frame + 1 if old else frame, posed.body_vertices, pose, rng)
        studio = Studio(posed, lights, samples=1)
        half = matrices + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
        shots = studio.shoot(capture.cameras_of(half, poses, size, size))
        for k, path in enumerate(photographs):
            image = capture.add_background(shots.images[k], shots.masks[k], 0.9 + 0.2 * k / len(names))
            _write_photograph(folder, path, *_distort(image, shots.masks[k], grids[k]), k)
    cams = {
        "K": list(matrices),
        "D": [lens.reshape(5, 1) for lens in lenses],
        "R": [pose[:3, :3].copy() for pose in poses],
        "T": [pose[:3, 3:] * 1000 for pose in poses],
    }
    np.save(folder / "annots.npy", {"cams": cams, "ims": listed})


def _short_stem(sequence: str, camera: str, frame: int) -> str:
    return f"{frame:06d}"


def _long_stem(sequence: str, camera: str, frame: int) -> str:
    return (
        f"CoreView_{sequence}_{camera.replace(' ', '_')}_{frame + 1:04d}_2019-08-23_16-08-50.{frame * 33:03d}"
    )


def _calibration(
    count: int, size: int, stage: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """K [n, 3, 3] with centres at integers, lens coefficients [n, 5], world to camera [n, 4, 4] in metres."""
    matrices, poses = np.zeros((count, 3, 3)), np.zeros((count, 4, 4))
    centers = capture.ring(count, 2.9, 1.2, rng) + stage
    for k in range(count):
        f = 1.03 * size * rng.uniform(0.99, 1.01)
        middle = size * rng.uniform(0.48, 0.52, 2)
        matrices[k] = [[f, 0, middle[0]], [0, f * rng.uniform(0.999, 1.001), middle[1]], [0, 0, 1]]
        target = stage + np.array([0, 0.92, 0]) + rng.uniform(-0.05, 0.05, 3)
        poses[k] = capture.look_at(centers[k], target, np.array([0, 1.0, 0])) @ _Z_UP.T
    lenses = np.array([-0.24, 0.14, 0.0, 0.0, -0.03]) * rng.uniform(0.9, 1.1, (count, 5))
    lenses[:, 2:4] = rng.uniform(-1e-3, 1e-3, (count, 2))
    return matrices, lenses, poses


def _write_body(
    folder: Path, number: int, vertices: np.ndarray, pose: np.ndarray, rng: np.random.Generator
) -> None:
    """Write both fits of one frame, with SMPL's number of vertices."""
    chosen = vertices[chosen_vertices()]
    worse = chosen + rng.normal(0, 0.015, 3)
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec()
    params = {
        "poses": np.zeros((1, 72), np.float32),
        "shapes": np.zeros((1, 10), np.float32),
        "Rh": turn[None].astype(np.float32),
        "Th": pose[None, :3, 3].astype(np.float32),
    }
    for prefix, fit in (("new_", chosen), ("", worse)):
        for kind, content in ((f"{prefix}vertices", fit.astype(np.float32)), (f"{prefix}params", params)):
            (folder / kind).mkdir(exist_ok=True)
            np.save(folder / kind / f"{number}.npy", content)


def _distorting_grid(matrix: np.ndarray, lens: np.ndarray, size: int) -> torch.Tensor:
    """Grid [1, h, w, 2] for ``grid_sample``: positions of distorted pixels in the undistorted photograph."""
    rows, columns = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    pixels = torch.stack((columns, rows), -1).reshape(1, -1, 2).double()
    places = undistort_points(
        pixels, torch.from_numpy(matrix)[None], torch.from_numpy(lens)[None], num_iters=20
    )
    return ((2 * places + 1) / size - 1).reshape(1, size, size, 2).float()


def _distort(image: np.ndarray, mask: np.ndarray, grid: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    layers = torch.from_numpy(np.concatenate((image, 255.0 * mask[..., None]), -1)).float()
    bent = F.grid_sample(layers.permute(2, 0, 1)[None], grid, padding_mode="border", align_corners=False)
    bent = bent[0].permute(1, 2, 0).numpy()
    return np.round(bent[..., :3]).astype(np.uint8), bent[..., 3] > 127.5


def _write_photograph(folder: Path, path: str, image: np.ndarray, mask: np.ndarray, camera: int) -> None:
    """Write a photograph and its two label maps, each with a hole that the other does not have."""
    capture.save_image(folder / path, image)
    rows = np.flatnonzero(mask.any(1))
    top, bottom = (rows[0], rows[-1] + 1) if len(rows) else (0, 1)
    band = np.clip((np.arange(len(mask)) - top) * len(_LABELS) // (bottom - top), 0, len(_LABELS) - 1)
    labels = np.where(mask, _LABELS[band][:, None], 0).astype(np.uint8)
    whole = mask.astype(np.uint8)
    hole = max(1, (bottom - top) // 40)
    labels[top : top + hole] = 0
    whole[bottom - hole : bottom] = 0
    if camera == 3:  # some real label maps have three channels
        labels = np.stack((labels, 0 * labels, 0 * labels), -1)
    for kind, content in (("mask_cihp", labels), ("mask", whole)):
        capture.save_image((folder / kind / path).with_suffix(".png"), content)
