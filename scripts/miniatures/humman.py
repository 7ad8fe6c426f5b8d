"""A small HuMMan-Recon v1.0 of built-in people, with the names, dtypes, units and oddities of the real one.

Ten Kinects; photographs of 16:9 in front of a wall; masks with soft edges; frame numbers that are
multiples of 6, one of them missing; the world frame is that of camera 0. Textured meshes and the
depth cameras, which no loader reads, are not written. A stand-in for the licensed SMPL model is
written next to the root.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageFilter

from ghgs_lit.types import Cameras
from ghgs_people import figures
from ghgs_people.figures.mesh import Person
from ghgs_people.lights import LightRig, Lights
from ghgs_people.photograph import Studio
from scripts.miniatures import capture
from scripts.miniatures.smpl import parameters, write_stand_in

KINECTS = 10
# Frame 12 is missing.
FRAMES = (0, 6, 18)
# Height, width and focal length in pixels of the real photographs.
_HEIGHT, _WIDTH, _FOCAL = 1080, 1920, 970.0


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
        people_of: numbers of sequences, ``{train: n, val: n}``.
        size: longer side of the photographs in pixels.
        seed: of people, cameras and lights.
        frames: frame numbers.

    Returns:
        The folders of the sequences, and last that of the stand-in for SMPL, ``<root>_body_models``.
    """
    training = [f"p{100001 + 7 * i:06d}_a{48 + 11 * i:06d}" for i in range(people_of["train"])]
    folders = []
    for index, name in enumerate([*training, *test[: people_of["val"]]]):
        folder = root / name
        folder.mkdir(parents=True, exist_ok=True)
        _write_sequence(folder, size / _WIDTH, frames, (seed, index))
        folders.append(folder)
    return [*folders, write_stand_in(body_models(root))]


def body_models(root: Path) -> Path:
    """The folder of the stand-in for SMPL, next to ``root``."""
    return root.with_name(f"{root.name}_body_models")


def _write_sequence(folder: Path, scale: float, frames: Sequence[int], identity: tuple[int, int]) -> None:
    rng = np.random.default_rng(identity)
    person, lights = figures.generate(*identity), Lights().draw(rng)
    cameras = _rig(scale, rng)
    # from the floor's frame to that of the first camera
    to_world = cameras.extrinsics[0].double().numpy()
    from_world = torch.from_numpy(np.linalg.inv(to_world))
    _write_cameras(folder, cameras, from_world)
    for number in frames:
        pose = capture.rigid_transform(
            4.0 * number, np.array([0.05 * np.sin(number), 0, 0.05 * np.cos(number)])
        )
        fit = parameters(*identity, person, to_world @ pose)
        (folder / "smpl_params").mkdir(exist_ok=True)
        np.savez(folder / "smpl_params" / f"{number:06d}.npz", **fit)
        _write_frame(folder, number, capture.move_person(person, pose), lights, cameras)


def _rig(scale: float, rng: np.random.Generator) -> Cameras:
    """Cameras around the floor's origin, y up, pixel centres at +0.5."""
    centers = capture.ring(KINECTS, 2.4, 1.1, rng)
    poses = np.stack([capture.look_at(c, np.array([0, 0.92, 0]), np.array([0, 1.0, 0])) for c in centers])
    height, width = round(_HEIGHT * scale), round(_WIDTH * scale)
    matrices = np.zeros((KINECTS, 3, 3))
    for k in range(KINECTS):
        focal = _FOCAL * scale * rng.uniform(0.99, 1.01)
        middle = np.array([width, height]) * rng.uniform(0.49, 0.51, 2)
        matrices[k] = [[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]]
    return capture.cameras_of(matrices, poses, height, width)


def _write_cameras(folder: Path, cameras: Cameras, from_world: torch.Tensor) -> None:
    """Write ``cameras.json``, with pixel centres at integers; the world frame is the first camera's."""
    content = {}
    for k in range(KINECTS):
        matrix = cameras.intrinsics[k].double()
        matrix[:2, 2] -= 0.5
        pose = cameras.extrinsics[k].double() @ from_world
        content[f"kinect_color_{k:03d}"] = {
            "K": matrix.tolist(), "R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()
        }  # fmt: skip
    (folder / "cameras.json").write_text(json.dumps(content))


def _write_frame(folder: Path, number: int, person: Person, lights: LightRig, cameras: Cameras) -> None:
    shots = Studio(person, lights, samples=1).shoot(cameras)
    for k in range(KINECTS):
        image = capture.add_background(shots.images[k], shots.masks[k], 0.9 + 0.02 * k)
        hard = Image.fromarray(shots.masks[k].astype(np.uint8) * 255)
        written = {
            "kinect_color": image.astype(np.uint8),
            "kinect_mask": hard.filter(ImageFilter.GaussianBlur(0.5)),
        }
        for kind, picture in written.items():
            capture.save_image(folder / kind / f"kinect_{k:03d}" / f"{number:06d}.png", picture)
