"""Skeleton of a pose: joints at rest, and rotations of bones."""

from dataclasses import dataclass

import numpy as np

from ghgs_people.figures.body import BodyModel


@dataclass(frozen=True)
class Skeleton:
    """Joints at rest [b, 3] and rotations [b, 3, 3] of the bones in world axes, which posing sets."""

    body: BodyModel
    joints: np.ndarray
    rotations: np.ndarray

    def rest(self, *bones: str, end: str = "") -> np.ndarray:
        """Look up joints at rest.

        Args:
            bones: names of k bones; a bone starts at its joint.
            end: suffix of every name, such as ``.L``.

        Returns:
            [k, 3], metres.
        """
        return self.joints[[self.body.bone(bone + end) for bone in bones]]

    def rotate(self, bone: str, rotation: np.ndarray) -> None:
        """Set the rotation of a bone.

        Args:
            bone: its name.
            rotation: [3, 3] in world axes.
        """
        self.rotations[self.body.bone(bone)] = rotation


def frame(along: np.ndarray, across: np.ndarray) -> np.ndarray:
    """Right-handed frame [3, 3] (columns) with first axis `along` and third axis nearest to `across`."""
    first = along / np.linalg.norm(along)
    third = across - (across @ first) * first
    third /= np.linalg.norm(third)
    return np.stack([first, np.cross(third, first), third], 1)
