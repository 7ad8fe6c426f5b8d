"""Common parts of the miniatures: cameras around a person, rigid motions, studios and image files."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from ghgs_lit.types import Cameras
from ghgs_people.figures.mesh import Person


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """World-to-camera matrix [4, 4] of an upright camera at ``center`` facing ``target`` (OpenCV axes)."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack((right, np.cross(forward, right), forward))
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def ring(count: int, radius: float, height: float, rng: np.random.Generator) -> np.ndarray:
    """Camera centres [count, 3] in order around the y axis, with random deviations, in metres."""
    angles = 2 * np.pi * (np.arange(count) + rng.uniform(-0.15, 0.15, count)) / count
    radii = radius * rng.uniform(0.93, 1.07, count)
    heights = height + rng.uniform(-0.35, 0.35, count)
    return np.stack((radii * np.sin(angles), heights, radii * np.cos(angles)), -1)


def rigid_transform(degrees: float, translation: np.ndarray) -> np.ndarray:
    """A rigid transform [4, 4]: a rotation about the y axis, then a ``translation`` [3]."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    pose[:3, 3] = translation
    return pose


def move_person(person: Person, pose: np.ndarray) -> Person:
    """``person`` in another frame: ``pose`` [4, 4] maps old to new coordinates."""
    return person.mapped(lambda vertices: vertices @ pose[:3, :3].T + pose[:3, 3])


def cameras_of(matrices: np.ndarray, poses: np.ndarray, height: int, width: int) -> Cameras:
    """Float32 cameras from intrinsics [n, 3, 3] and world-to-camera poses [n, 4, 4]."""
    return Cameras(*(torch.from_numpy(array).float() for array in (matrices, poses)), height, width)


def add_background(image: np.ndarray, mask: np.ndarray, brightness: float) -> np.ndarray:
    """Compose an image [h, w, 3] in [0, 1] of a person with a studio, in [0, 255].

    The studio is a grey wall above a brown floor, so that unmasked background is visible.
    """
    rows = np.linspace(0, 1, len(mask))[:, None, None]
    wall = np.array([150, 155, 160]) * (0.8 + 0.3 * rows) * brightness
    floor = np.array([120, 95, 70]) * (0.7 + 0.3 * rows)
    studio = np.where(rows < 0.8, wall, floor).astype(np.uint8)
    return np.where(mask[..., None], np.round(image * 255), studio)


def save_image(path: Path, image: np.ndarray | Image.Image, quality: int = 95) -> None:
    """Write an image and create its folder; ``quality`` applies to JPEG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = image if isinstance(image, Image.Image) else Image.fromarray(image)
    image.save(path, quality=quality)
