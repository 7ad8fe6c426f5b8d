"""A small HuMMan-Recon v1.0 of built-in people: folders, names, dtypes, units and oddities of the real one.

Ten Kinects; photographs of 16:9 in front of a wall; masks with soft edges; depth maps in millimetres from
other cameras, with the floor in them; frame numbers that are multiples of 6, one of them missing; the world
frame is that of camera 0. Textured meshes, which nothing reads, are not made. A stand-in for the licensed
SMPL model is written beside the root.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageFilter

from ghgs_lit.synthesis import people
from ghgs_lit.synthesis.people.mesh import Person
from ghgs_lit.synthesis.photograph import LightRig, Lights, Studio
from ghgs_lit.types import Cameras
from scripts.miniatures import capture
from scripts.miniatures.smpl import parameters, write_stand_in

KINECTS = 10
# Frame 12 is missing.
FRAMES = (0, 6, 18)
# Height, width and focal length in pixels of the real photographs and of the real depth maps.
_COLOR, _DEPTH = (1080, 1920, 970.0), (576, 640, 504.0)
# Position of the depth camera in the frame of the colour camera, metres.
_DEPTH_OFFSET = np.array([0.032, 0.002, 0.0])


def make(
    root: Path,
    test: Sequence[str],
    people_of: Mapping[str, int],
    size: int = 256,
    seed: int = 0,
    frames: Sequence[int] = FRAMES,
) -> list[Path]:
    """Write training sequences, and test sequences with the first names of ``test``.

    Args:
        root: folder of the sequences.
        test: names of the test sequences.
        people_of: how many sequences, ``{train: n, val: n}``.
        size: longer side of the photographs in pixels.
        seed: of people, cameras and lights.
        frames: their numbers.

    Returns:
        The folders of the sequences, and last that of the stand-in for SMPL, ``<root>_body_models``.
    """
    training = [f"p{100001 + 7 * i:06d}_a{48 + 11 * i:06d}" for i in range(people_of["train"])]
    folders = []
    for index, name in enumerate([*training, *test[: people_of["val"]]]):
        folder = root / name
        folder.mkdir(parents=True, exist_ok=True)
        _write_sequence(folder, size / _COLOR[1], frames, (seed, index), manual=index >= len(training))
        folders.append(folder)
    return [*folders, write_stand_in(body_models(root))]


def body_models(root: Path) -> Path:
    """The folder of the stand-in for SMPL, beside the sequences in ``root``."""
    return root.with_name(f"{root.name}_body_models")


def _write_sequence(
    folder: Path, scale: float, frames: Sequence[int], identity: tuple[int, int], manual: bool
) -> None:
    rng = np.random.default_rng(identity)
    person, lights = people.generate(*identity), Lights().draw(rng)
    color, depth = _rig(scale, rng)
    to_world = color.extrinsics[0].double().numpy()  # from the floor's frame to that of the first camera
    from_world = torch.from_numpy(np.linalg.inv(to_world))
    _write_cameras(folder, color, depth, from_world)
    for number in frames:
        pose = capture.rigid(4.0 * number, np.array([0.05 * np.sin(number), 0, 0.05 * np.cos(number)]))
        fit = parameters(*identity, person, to_world @ pose)
        (folder / "smpl_params").mkdir(exist_ok=True)
        np.savez(folder / "smpl_params" / f"{number:06d}.npz", **fit)
        _write_frame(folder, number, capture.moved(person, pose), lights, color, depth, manual)


def _rig(scale: float, rng: np.random.Generator) -> tuple[Cameras, Cameras]:
    """Colour and depth cameras around the floor's origin, y up, pixel centres at +0.5."""
    centers = capture.ring(KINECTS, 2.4, 1.1, rng)
    poses = np.stack([capture.look_at(c, np.array([0, 0.92, 0]), np.array([0, 1.0, 0])) for c in centers])
    beside = poses.copy()
    beside[:, :3, 3] -= _DEPTH_OFFSET
    return _cameras(_COLOR, scale, poses, rng), _cameras(_DEPTH, scale, beside, rng)


def _cameras(
    shape: tuple[int, int, float], scale: float, poses: np.ndarray, rng: np.random.Generator
) -> Cameras:
    height, width = (round(side * scale) for side in shape[:2])
    matrices = np.zeros((len(poses), 3, 3))
    for k in range(len(poses)):
        focal = shape[2] * scale * rng.uniform(0.99, 1.01)
        middle = np.array([width, height]) * rng.uniform(0.49, 0.51, 2)
        matrices[k] = [[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]]
    return capture.cameras_of(matrices, poses, height, width)


def _write_cameras(folder: Path, color: Cameras, depth: Cameras, from_world: torch.Tensor) -> None:
    """Write ``cameras.json``: pixel centres at integers, the world frame is the first colour camera's."""
    content = {}
    for kind, cameras in (("color", color), ("depth", depth)):
        for k in range(KINECTS):
            matrix = cameras.intrinsics[k].double()
            matrix[:2, 2] -= 0.5
            pose = cameras.extrinsics[k].double() @ from_world
            content[f"kinect_{kind}_{k:03d}"] = {
                "K": matrix.tolist(), "R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()
            }  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps(content))


def _write_frame(
    folder: Path, number: int, person: Person, lights: LightRig, color: Cameras, depth: Cameras, manual: bool
) -> None:
    studio = Studio(person, lights, samples=1)
    shots, depths = studio.shoot(color), studio.shoot(depth).depths
    for k in range(KINECTS):
        image = capture.before_wall(shots.images[k], shots.masks[k], 0.9 + 0.02 * k)
        hard = Image.fromarray(shots.masks[k].astype(np.uint8) * 255)
        floor = _floor_depth(depth, k)
        metres = np.where(depths[k] > 0, depths[k], np.where(floor < 5.4, floor, 0))
        written = {
            "kinect_color": image.astype(np.uint8),
            "kinect_mask": hard.filter(ImageFilter.GaussianBlur(0.5)),
            "kinect_depth": np.round(metres * 1000).astype(np.uint16),
        }
        if manual:
            written["kinect_mask_manual"] = hard
        for kind, picture in written.items():
            capture.save_image(folder / kind / f"kinect_{k:03d}" / f"{number:06d}.png", picture)


def _floor_depth(cameras: Cameras, k: int) -> np.ndarray:
    """z [h, w] in camera ``k`` of the floor y = 0; infinite where rays do not reach it."""
    matrix, pose = cameras.intrinsics[k].double().numpy(), cameras.extrinsics[k].double().numpy()
    rows, columns = np.mgrid[: cameras.height, : cameras.width] + 0.5
    rays = np.stack((columns, rows, np.ones_like(rows)), -1) @ np.linalg.inv(matrix).T @ pose[:3, :3]
    height = -(pose[:3, :3].T @ pose[:3, 3])[1]
    down = -rays[..., 1]
    return np.where(down > 1e-6, height / np.where(down > 1e-6, down, 1), np.inf)
