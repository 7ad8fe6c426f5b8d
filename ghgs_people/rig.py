"""Ring of cameras with which THuman2.0 is rendered, and placement of a subject in it.

``positions`` cameras are evenly spaced around the subject. The views at each position are numbered: 0 is
the ring camera itself, 1 the next ring camera, 3 exactly halfway between the two, 2 and 4 are random in
the first and the second half of the step. A camera at yaw 0 sees the front of a subject that faces +z. A
:class:`Variation` changes the ring per subject and moves single cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch
from pydantic import Field, model_validator

from ghgs_lit.config.options import Amount, Options, Positive
from ghgs_lit.errors import require
from ghgs_lit.types import Cameras
from ghgs_people.figures.mesh import Person

# Margin around a subject with a varied ``fill``, as a fraction of the image's height
_MARGIN = 0.01

Pitch = Annotated[float, Field(gt=-89, lt=89)]
Tilt = Annotated[float, Field(ge=0, lt=45)]
Fill = Annotated[float, Field(gt=0, lt=1)]


class Variation(Options):
    """Variation of rigs between subjects, and of single cameras from their ring; null or 0: none."""

    group = "data.rig.variation"

    radius: tuple[Positive, Positive] | None = None
    """[least, greatest] radius of a subject's ring, in metres."""
    pitch: tuple[Pitch, Pitch] | None = None
    """[least, greatest] pitch of a subject's ring, in degrees; a ring that looks down is higher."""
    fill: tuple[Fill, Fill] | None = None
    """[least, greatest] fraction of the image's height that a subject fills in the camera where it is
    tallest, which sets the focal length. Less if it would not fit into every image of the ring."""
    camera_pitch: Tilt = 0.0
    """Largest deviation of the pitch of single cameras, in degrees."""
    camera_roll: float = Field(0.0, ge=0, le=180)
    """Largest roll of single cameras, in degrees."""
    camera_look_at: Amount = 0.0
    """Largest shift of single cameras and of the points they look at along each axis, in metres."""
    between_pitch: Tilt = 0.0
    """Largest deviation of the pitch of views between ring cameras (2, 3 and 4), in degrees. Only targets
    use these views, so subjects are also seen from higher and lower than in any input."""

    @model_validator(mode="after")
    def _check(self) -> "Variation":
        for name in ("radius", "pitch", "fill"):
            low, high = getattr(self, name) or (0, 0)
            self.require(low <= high, name, "[least, greatest]")
        return self


#: No variation.
STILL = Variation()


class RigOptions(Options):
    """Ring of cameras with which the published scripts render THuman2.0."""

    group = "data.rig"

    height: Positive | None = 1.80
    """Height in metres to which subjects are scaled, +-0.05; null: their own height."""
    variation: Variation = Variation()
    """Variation of the rig between subjects and of single cameras."""

    def build(self) -> "Rig":
        return Rig(height=self.height, variation=self.variation)


@dataclass(frozen=True)
class Rig:
    """A ring of cameras, by default that of the published scripts."""

    positions: int = 16
    radius: float = 2.0  # distance of the cameras from ``look_at``, metres
    # point that all cameras look at, metres
    look_at: tuple[float, float, float] = (0.0, 0.85, 0.0)
    pitch: float = -8.0  # degrees; below 0 the cameras look down
    focal: float = 0.8  # focal length as a fraction of the image's height
    # offset of the principal point below the centre, as a fraction of the image's height
    shift_y: float = 25 / 1024
    yaw_jitter: float = 11.0  # largest rotation of the ring of a subject, degrees
    # height that subjects are scaled to, metres (None: they keep their own)
    height: float | None = 1.80
    height_jitter: float = 0.05  # largest deviation from ``height``, metres
    variation: Variation = STILL

    def yaws(self, rng: np.random.Generator) -> np.ndarray:
        """Sample the yaws of all views of one subject.

        Args:
            rng: samples the rotation of the ring and the positions of views 2 and 4 between ring cameras.

        Returns:
            Yaws [positions, 5] in degrees of views 0 to 4.
        """
        step = 360.0 / self.positions
        start = rng.uniform(-self.yaw_jitter, self.yaw_jitter) + step * np.arange(self.positions)
        first, second = rng.uniform(0, 0.5, (2, self.positions))
        offsets = np.stack((0 * first, 0 * first + 1, first, 0 * first + 0.5, 0.5 + second), -1)
        return start[:, None] + step * offsets

    def cameras(self, yaws: np.ndarray, height: int, width: int, poses: np.ndarray | None = None) -> Cameras:
        """Create cameras of the ring.

        Args:
            yaws: degrees about y, any shape; 0 sees the front of a subject that faces +z.
            height: height of the images, pixels.
            width: width of the images, pixels.
            poses: deviations [..., 5] of the cameras: pitch and roll in degrees, shift along three axes in
                metres; None: none.

        Returns:
            Cameras in the shape of ``yaws``, float32, metres.
        """
        poses = np.zeros((*np.shape(yaws), 5)) if poses is None else poses
        yaw, pitch, roll = (
            np.radians(angle)[..., None] for angle in (yaws, self.pitch + poses[..., 0], poses[..., 1])
        )
        backward = np.concatenate(
            (np.cos(pitch) * np.sin(yaw), -np.sin(pitch), np.cos(pitch) * np.cos(yaw)), -1
        )
        level = np.concatenate((np.cos(yaw), np.zeros_like(yaw), -np.sin(yaw)), -1)
        down = -np.cross(backward, level)
        right = np.cos(roll) * level + np.sin(roll) * down
        down = np.cos(roll) * down - np.sin(roll) * level
        rotation = np.stack((right, down, -backward), -2)
        center = np.asarray(self.look_at) + poses[..., 2:] + self.radius * backward
        extrinsics = np.zeros((*np.shape(yaws), 4, 4))
        extrinsics[..., :3, :3] = rotation
        extrinsics[..., :3, 3] = -(rotation @ center[..., None])[..., 0]
        extrinsics[..., 3, 3] = 1
        focal = self.focal * height
        intrinsics = np.zeros((*np.shape(yaws), 3, 3))
        intrinsics[...] = [[focal, 0, width / 2], [0, focal, height / 2 + self.shift_y * height], [0, 0, 1]]
        intrinsics = intrinsics.astype(np.float32)
        extrinsics = extrinsics.astype(np.float32)
        return Cameras(torch.from_numpy(intrinsics), torch.from_numpy(extrinsics), height, width)

    def vary(
        self, person: Person, yaws: np.ndarray, aspect: float, rng: np.random.Generator
    ) -> tuple["Rig", np.ndarray]:
        """Sample the rig of one subject and the deviations of its cameras from ``variation``.

        Args:
            person: the placed subject, metres.
            yaws: degrees [positions, 5] of all its views (:meth:`yaws`).
            aspect: width / height of the images.
            rng: used only for the rig; samples the same numbers for every ``variation``.

        Returns:
            The rig without variation, and the deviations [positions, 5, 5] of its cameras (:meth:`cameras`).

        Raises:
            InputError: ``fill`` varies and a point of the subject is behind a camera.
        """
        v = self.variation
        share = rng.uniform(size=3)
        deviations = rng.uniform(-1, 1, (*yaws.shape, 5))
        deviations[:, 1] = np.roll(deviations[:, 0], -1, 0)  # view 1 is the next ring camera
        # sampled last, so that the numbers above do not change
        higher = rng.uniform(-1, 1, yaws.shape)
        higher[:, :2] = 0
        poses = deviations * np.array([v.camera_pitch, v.camera_roll, *[v.camera_look_at] * 3])
        poses[..., 0] += v.between_pitch * higher
        radius = _within(v.radius, share[0], self.radius)
        ring_pitch = _within(v.pitch, share[1], self.pitch)
        rig = replace(self, radius=radius, pitch=ring_pitch, variation=STILL)
        if v.fill is None:
            return rig, poses
        low, high = rig._extents(person, yaws, poses)
        room = np.array([aspect, 1]) / 2 - _MARGIN
        middle = np.array([0, self.shift_y])
        reach = np.maximum(-low / (room + middle), high / (room - middle)).max()
        tallest = (high - low)[:, 1].max()
        return replace(rig, focal=float(min(_within(v.fill, share[2], 0.0) / tallest, 1 / reach))), poses

    def _extents(self, person: Person, yaws: np.ndarray, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Smallest and largest (x/z, y/z) [n, 2] of a placed subject in n cameras."""
        vertices = np.concatenate([part.vertices for part in person.parts])
        low = []
        high = []
        for pose in self.cameras(yaws, 1, 1, poses).extrinsics.flatten(0, 1).numpy():
            points = vertices @ pose[:3, :3].T + pose[:3, 3]
            near = f"a ring farther from {person.name}: its points in front of all cameras"
            require(points[:, 2].min() > 1e-3, "data.rig.radius", near, self.radius)
            places = points[:, :2] / points[:, 2:]
            low.append(places.min(0))
            high.append(places.max(0))
        return np.stack(low), np.stack(high)

    def place(self, person: Person, rng: np.random.Generator) -> Person:
        """Scale and centre a person and its body vertices, with the feet on y = 0.

        Args:
            person: a person in any unit, y up.
            rng: samples the height.

        Returns:
            The person in metres; with its own height and unit if ``height`` is None.

        Raises:
            InputError: the person has no height.
        """
        jitter = self.height_jitter * rng.uniform(-1, 1)
        low = np.min([part.vertices.min(0) for part in person.parts if len(part.vertices)], 0)
        high = np.max([part.vertices.max(0) for part in person.parts if len(part.vertices)], 0)
        tall = float(high[1] - low[1])
        require(tall > 0, person.name, "a mesh with some height", tall)
        scale = 1.0 if self.height is None else (self.height + jitter) / tall
        origin = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2], np.float64)
        return person.mapped(lambda vertices: (vertices - origin) * scale)


def _within(limits: Sequence[float] | None, share: float, default: float) -> float:
    return default if limits is None else float(limits[0] + share * (limits[1] - limits[0]))
