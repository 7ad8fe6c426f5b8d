"""A user's own cameras as a rig around built-in people, photographed in crops like those of
captures. Positions are the cameras in the order of their azimuth about the subject. Views at a
position are numbered as in :mod:`ghgs_people.rig`; those between two cameras turn about the subject
from one to the next."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from ghgs_lit.config.options import Options, Side
from ghgs_lit.errors import require
from ghgs_lit.types import Cameras
from ghgs_people.figures.mesh import Person
from ghgs_people.rig import STILL, Poses, Rig, Variation

#: Share of a crop's height or width that the subject takes, as in crops of photographs.
SHARE = 0.8
# Largest distance of subjects from the point that the cameras look at, as a share of their height.
_ASIDE = 0.1
# Smallest cosine between the optical axes of cameras that look in one direction.
_PARALLEL = 0.999

Row3 = tuple[float, float, float]
Row4 = tuple[float, float, float, float]


class RigCamera(Options):
    """A camera of a rig, without distortion."""

    group = "data.cameras"

    intrinsics: tuple[Row3, Row3, Row3]
    """In pixels, pixel centres at +0.5."""
    extrinsics: tuple[Row4, Row4, Row4, Row4]
    """World to camera, OpenCV axes, in any unit."""
    width: Side
    """Of the photographs, in pixels."""
    height: Side
    """Of the photographs, in pixels."""


@dataclass(frozen=True)
class CaptureRig:
    """Cameras in an unknown unit.

    Args:
        intrinsics: [3, 3] of each camera, in pixels.
        extrinsics: [4, 4] of each camera, world to camera, in any unit.
        heights: of each camera's photographs, pixels.
        fill: [least, greatest] share of the photograph's height that a subject takes in the camera
            that sees it tallest, 0 to 1; decides how far the cameras stand.
    """

    intrinsics: tuple
    extrinsics: tuple
    heights: tuple[int, ...]
    fill: tuple[float, float]

    variation: ClassVar[Variation] = STILL

    @classmethod
    def of(cls, cameras: Sequence[RigCamera], fill: tuple[float, float]) -> "CaptureRig":
        """Order the cameras of a capture by their azimuth about what they look at.

        Args:
            cameras: two or more.
            fill: [least, greatest] share of the photograph's height that a subject takes, 0 to 1.

        Raises:
            InputError: there are fewer cameras, they look in one direction, or the point that they
                look at is behind one of them.
        """
        require(len(cameras) > 1, "data.cameras", "two or more cameras", len(cameras))
        rig = cls(
            tuple(camera.intrinsics for camera in cameras),
            tuple(camera.extrinsics for camera in cameras),
            tuple(camera.height for camera in cameras),
            fill,
        )
        rotations = rig._poses[:, :3, :3]
        turned = (rotations[:, 2] @ rotations[:, 2].T).min() < _PARALLEL
        require(bool(turned), "data.cameras", "cameras that look in several directions", "one direction")
        depths = rig._distances
        expected = "cameras that look at one place (their axes meet before them)"
        require(bool((depths > 0).all()), "data.cameras", expected, f"depths {depths.round(3).tolist()}")
        order = np.argsort(rig._azimuths)
        return cls(
            tuple(rig.intrinsics[i] for i in order),
            tuple(rig.extrinsics[i] for i in order),
            tuple(rig.heights[i] for i in order),
            fill,
        )

    @property
    def positions(self) -> int:
        """Number of cameras."""
        return len(self.heights)

    @cached_property
    def _poses(self) -> np.ndarray:
        return np.asarray(self.extrinsics, np.float64)

    @cached_property
    def _middle(self) -> np.ndarray:
        """The point [3] of the world nearest to all optical axes."""
        rotations = self._poses[:, :3, :3]
        axes = self._poses[:, 2, :3]
        centers = -(rotations.mT @ self._poses[:, :3, 3:])[..., 0]
        across = np.eye(3) - axes[:, :, None] * axes[:, None]
        return np.linalg.lstsq(across.sum(0), (across @ centers[..., None]).sum(0)[:, 0], rcond=None)[0]

    @cached_property
    def _distances(self) -> np.ndarray:
        """Depths [n] of :attr:`_middle` in the cameras, in their unit."""
        return self._poses[:, 2, :3] @ self._middle + self._poses[:, 2, 3]

    @cached_property
    def _upright(self) -> np.ndarray:
        """Rotation [3, 3] from the world to one whose y points up. Cameras are assumed level: up is
        orthogonal to all image rows. If all rows are parallel, it is the mean up direction of
        the images."""
        rows = self._poses[:, 0, :3]
        mean = -self._poses[:, 1, :3].mean(0)
        _, strengths, axes = np.linalg.svd(rows)
        up = axes[2] * np.sign(axes[2] @ mean) if strengths[1] > 0.1 * strengths[0] else mean
        up = up / np.linalg.norm(up)
        side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
        side /= np.linalg.norm(side)
        return np.stack((side, up, np.cross(side, up)))

    @cached_property
    def _around(self) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [n, 3, 3] and translations [n, 3] for a world with origin
        :attr:`_middle` and y up."""
        shifts = self._poses[:, :3, :3] @ self._middle + self._poses[:, :3, 3]
        return self._poses[:, :3, :3] @ self._upright.T, shifts

    @property
    def _azimuths(self) -> np.ndarray:
        rotations, shifts = self._around
        centers = -(rotations.mT @ shifts[..., None])[..., 0]
        return np.arctan2(centers[:, 0], centers[:, 2])

    def yaws(self, rng: np.random.Generator) -> np.ndarray:
        """Draw the places of all views of a subject.

        Args:
            rng: draws where the views 2 and 4 stand between two cameras.

        Returns:
            Places [positions, 5] of views 0 to 4: 1.5 is half-way from camera 1 to camera 2.
        """
        first, second = rng.uniform(0, 0.5, (2, self.positions))
        offsets = np.stack((0 * first, 0 * first + 1, first, 0 * first + 0.5, 0.5 + second), -1)
        return np.arange(self.positions)[:, None] + offsets

    def place(self, person: Person, rng: np.random.Generator) -> Person:
        """Turn a person by a random angle about y, at its own height, the feet on y = 0.

        Args:
            person: in metres, y up.
            rng: draws the angle.
        """
        angle = rng.uniform(0, 2 * np.pi)
        turn = Rotation.from_euler("y", angle).as_matrix()
        return Rig(height=None).place(person, rng).mapped(lambda vertices: vertices @ turn.T)

    def drawn(
        self, person: Person, yaws: np.ndarray, aspect: float, rng: np.random.Generator
    ) -> tuple["PlacedRig", Poses]:
        """Place the cameras around one subject.

        Args:
            person: the subject, in metres, y up.
            yaws: places [positions, 5] of all views (:meth:`yaws`).
            aspect: width / height of the images; not used, as crops fit their subject.
            rng: draws the subject's share of the image's height, and how far it stands from the
                point that the cameras look at.

        Returns:
            The placed cameras, and their deviations, which are 0.
        """
        vertices = np.concatenate([part.vertices for part in person.parts])
        low = vertices.min(0)
        high = vertices.max(0)
        tall = high[1] - low[1]
        share = rng.uniform(*self.fill)
        focal = np.array([matrix[1][1] for matrix in self.intrinsics]) / np.asarray(self.heights)
        scale = (focal * tall / self._distances).max() / share
        middle = (low + high) / 2 + tall * _ASIDE * rng.uniform(-1, 1, 3) * [1, 0, 1]
        none = np.zeros(yaws.shape)
        return PlacedRig(self, scale, middle, vertices), Poses(none, none, np.zeros((*yaws.shape, 3)))


@dataclass(frozen=True)
class PlacedRig:
    """A rig around one subject.

    Args:
        rig: the cameras.
        scale: metres per unit of the cameras.
        middle: the point [3] that the cameras look at, in the subject's world, metres.
        vertices: [n, 3] of the subject, metres.
    """

    rig: CaptureRig
    scale: float
    middle: np.ndarray
    vertices: np.ndarray

    def cameras(self, yaws: np.ndarray, height: int, width: int, poses: Poses | None = None) -> Cameras:
        """Cameras of crops around the subject.

        Args:
            yaws: k places, of :meth:`CaptureRig.yaws`.
            height: of the crops, pixels.
            width: of the crops, pixels.
            poses: deviations; none is applied.

        Returns:
            Cameras [k], float32.

        Raises:
            InputError: a point of the subject is behind a camera.
        """
        rotations, shifts = self._poses(np.asarray(yaws))
        shifts = self.scale * shifts - rotations @ self.middle
        first, then, share = _neighbours(np.asarray(yaws), self.rig.positions)
        matrices = np.asarray(self.rig.intrinsics, np.float64)
        matrices = (1 - share)[:, None, None] * matrices[first] + share[:, None, None] * matrices[then]
        extrinsics = np.zeros((len(rotations), 4, 4))
        extrinsics[:, :3, :3] = rotations
        extrinsics[:, :3, 3] = shifts
        extrinsics[:, 3, 3] = 1
        crops = [self._crop(k, e, (width, height)) for k, e in zip(matrices, extrinsics, strict=True)]
        arrays = (torch.from_numpy(np.stack(a).astype(np.float32)) for a in (crops, extrinsics))
        return Cameras(*arrays, height, width)

    def _poses(self, yaws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [k, 3, 3] and translations [k, 3] about the middle, in the cameras' unit."""
        rotations, shifts = self.rig._around
        centers = -(rotations.mT @ shifts[..., None])[..., 0]
        round_about = np.stack(
            (self.rig._azimuths, np.hypot(centers[:, 0], centers[:, 2]), centers[:, 1]), -1
        )
        # Rotation of each camera relative to one that looks at the middle.
        turns = Rotation.from_matrix(rotations @ _looking_inwards(centers).mT).as_rotvec()
        first, then, share = _neighbours(yaws, self.rig.positions)
        step = round_about[then] - round_about[first]
        step[:, 0] %= 2 * np.pi
        azimuth, radius, level = (round_about[first] + share[:, None] * step).T
        between = np.stack((radius * np.sin(azimuth), level, radius * np.cos(azimuth)), -1)
        turn = Rotation.from_rotvec((1 - share)[:, None] * turns[first] + share[:, None] * turns[then])
        rotation = turn.as_matrix() @ _looking_inwards(between)
        return rotation, -(rotation @ between[..., None])[..., 0]

    def _crop(self, matrix: np.ndarray, pose: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        """Intrinsics of a crop with the subject in its middle.

        Args:
            matrix: intrinsics [3, 3] of the whole photograph, pixels.
            pose: extrinsics [4, 4], metres.
            size: width and height of the crop, pixels.

        Returns:
            Intrinsics [3, 3], under which the subject takes ``SHARE`` of the width or height.

        Raises:
            InputError: a point of the subject is behind the camera.
        """
        points = self.vertices @ pose[:3, :3].T + pose[:3, 3]
        near = "cameras farther from the subject than it is wide (data.fill is less)"
        require(points[:, 2].min() > 1e-3, "data.cameras", near, f"a depth of {points[:, 2].min():.3g} m")
        pixels = (points @ matrix.T)[:, :2] / points[:, 2:]
        low = pixels.min(0)
        high = pixels.max(0)
        factor = (SHARE * np.asarray(size) / (high - low)).min()
        crop = matrix.copy()
        crop[:2, 2] -= (low + high) / 2
        crop[:2] *= factor
        crop[:2, 2] += np.asarray(size) / 2
        return crop


def _neighbours(yaws: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cameras [k] before and after each place, and the share [k] of the way between them."""
    first = np.floor(yaws).astype(int)
    return first % count, (first + 1) % count, yaws - first


def _looking_inwards(centers: np.ndarray) -> np.ndarray:
    """Rotations [k, 3, 3] of level cameras at ``centers`` [k, 3] that look at the origin, y up."""
    forward = -centers / np.linalg.norm(centers, axis=-1, keepdims=True)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.maximum(np.linalg.norm(right, axis=-1, keepdims=True), 1e-9)
    return np.stack((right, np.cross(forward, right), forward), -2)
