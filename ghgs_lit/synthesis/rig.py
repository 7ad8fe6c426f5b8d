"""The ring of cameras that THuman2.0 is rendered with, and how a subject is placed in it.

``positions`` cameras stand evenly around the subject. The views at each position are numbered: 0 is the
ring camera itself, 1 the next ring camera, 3 the exact middle between the two, 2 and 4 are random in the
first and the second half of the step. Yaw 0 looks at a subject that faces +z from the front.
"""

from dataclasses import dataclass

import numpy as np
import torch

from ghgs_lit.config.settings import set_fields
from ghgs_lit.errors import require
from ghgs_lit.synthesis.people.mesh import Person
from ghgs_lit.types import Cameras


@dataclass(frozen=True)
class Rig:
    """A ring of cameras.

    Attributes:
        positions: number of cameras.
        radius: distance of the cameras from ``look_at``, metres.
        look_at: the point that all cameras look at, metres.
        pitch: degrees; below 0 the cameras look down.
        focal: focal length as a fraction of the image's height.
        shift_y: offset of the principal point below the centre, as a fraction of the image's height.
        yaw_jitter: the ring of each subject is turned by up to this angle, degrees.
        height: height that subjects are scaled to, metres (null: they keep their own).
        height_jitter: greatest deviation from ``height``, metres.
    """

    positions: int = 16
    radius: float = 2.0
    look_at: tuple[float, float, float] = (0.0, 0.85, 0.0)
    pitch: float = -8.0
    focal: float = 0.8
    shift_y: float = 25 / 1024
    yaw_jitter: float = 11.0
    height: float | None = 1.80
    height_jitter: float = 0.05

    def __post_init__(self) -> None:
        require(self.positions >= 2, "rig.positions", "at least 2", self.positions)
        require(self.radius > 0, "rig.radius", "more than 0", self.radius)
        require(len(self.look_at) == 3, "rig.look_at", "three coordinates", self.look_at)
        require(-89 < self.pitch < 89, "rig.pitch", "between -89 and 89 degrees", self.pitch)
        require(self.focal > 0, "rig.focal", "more than 0", self.focal)
        require(self.height is None or self.height > 0, "rig.height", "more than 0 or null", self.height)
        set_fields(self, look_at=tuple(self.look_at))

    def yaws(self, rng: np.random.Generator) -> np.ndarray:
        """Yaws [positions, 5] in degrees of all views of one subject."""
        step = 360.0 / self.positions
        start = rng.uniform(-self.yaw_jitter, self.yaw_jitter) + step * np.arange(self.positions)
        first, second = rng.uniform(0, 0.5, (2, self.positions))
        offsets = np.stack((0 * first, 0 * first + 1, first, 0 * first + 0.5, 0.5 + second), -1)
        return start[:, None] + step * offsets

    def cameras(self, yaws: np.ndarray, height: int, width: int) -> Cameras:
        """Cameras of the ring, float32.

        Args:
            yaws: degrees, any shape.
            height, width: image size in pixels.
        """
        yaw, pitch = np.radians(yaws)[..., None], np.radians(self.pitch)
        zero = np.zeros_like(yaw)
        backward = np.concatenate(
            (np.cos(pitch) * np.sin(yaw), zero - np.sin(pitch), np.cos(pitch) * np.cos(yaw)), -1
        )
        right = np.concatenate((np.cos(yaw), zero, -np.sin(yaw)), -1)
        rotation = np.stack((right, -np.cross(backward, right), -backward), -2)
        center = np.asarray(self.look_at) + self.radius * backward
        extrinsics = np.zeros((*np.shape(yaws), 4, 4))
        extrinsics[..., :3, :3] = rotation
        extrinsics[..., :3, 3] = -(rotation @ center[..., None])[..., 0]
        extrinsics[..., 3, 3] = 1
        focal = self.focal * height
        intrinsics = np.zeros((*np.shape(yaws), 3, 3))
        intrinsics[...] = [[focal, 0, width / 2], [0, focal, height / 2 + self.shift_y * height], [0, 0, 1]]
        intrinsics, extrinsics = intrinsics.astype(np.float32), extrinsics.astype(np.float32)
        return Cameras(torch.from_numpy(intrinsics), torch.from_numpy(extrinsics), height, width)

    def place(self, person: Person, rng: np.random.Generator) -> Person:
        """Scale a person, put the feet on y = 0 and centre it; the body vertices move along."""
        jitter = self.height_jitter * rng.uniform(-1, 1)
        low = np.min([part.vertices.min(0) for part in person.parts if len(part.vertices)], 0)
        high = np.max([part.vertices.max(0) for part in person.parts if len(part.vertices)], 0)
        tall = float(high[1] - low[1])
        require(tall > 0, person.name, "a mesh with some height", tall)
        scale = 1.0 if self.height is None else (self.height + jitter) / tall
        origin = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2], np.float64)
        return person.mapped(lambda vertices: (vertices - origin) * scale)
