"""Built-in people in motion: from one pose to another and back, at instants of 1/30 s. At the first instant a
person in motion equals the still one of the same number. Only vertices move: faces, texture coordinates and
textures (with the shadows of the first instant) are the same at all instants."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ghgs_lit.synthesis.people.ambient_occlusion import occluding_spheres
from ghgs_lit.synthesis.people.body import BODY_VERTICES, BodyModel, bone_transforms, skin
from ghgs_lit.synthesis.people.garments import Figure
from ghgs_lit.synthesis.people.generate import MAX_POSES, Character, arm_depth, pose_figure
from ghgs_lit.synthesis.people.mesh import Person

#: Part of the keys of caches: to be increased when people of the same number move differently.
VERSION = 1
#: Instants from one pose to the other: one second.
PASSAGE = 30


def instant_names(person: str, instants: int) -> tuple[str, ...]:
    """Names of a person's subjects, one for each instant; with 0 instants the person's name."""
    return tuple(f"{person}_t{i:03d}" for i in range(instants)) or (person,)


def shares(instants: int) -> np.ndarray:
    """Positions [instants] between the two poses (0 and 1), at an even speed except near them."""
    even = 0.95  # at 1 a person would turn back abruptly
    return 0.5 - np.arcsin(even * np.cos(np.pi * np.arange(instants) / PASSAGE)) / (2 * np.arcsin(even))


@dataclass(frozen=True)
class Motion:
    """The motion between two figures of one shape."""

    body: BodyModel
    first: Figure
    second: Figure

    def at(self, share: float) -> Figure:
        """The figure at a share of the way. Each bone turns about a fixed axis of its parent; the foot that
        is lower in both poses stays in its place, the lowest vertex on the ground."""
        body, first = self.body, self.first
        start, end = (self._local(figure.transforms[:, :, :3]) for figure in (first, self.second))
        rotations = (start * Rotation.from_rotvec(share * (start.inv() * end).as_rotvec())).as_matrix()
        for bone, parent in enumerate(body.bone_parents):
            if parent >= 0:
                rotations[bone] = rotations[parent] @ rotations[bone]
        transforms = bone_transforms(body.bone_parents, first.joints, rotations, np.zeros(3))
        posed = skin(first.rest[:BODY_VERTICES], body.weights[:BODY_VERTICES], transforms)
        feet = [self._feet(figure.transforms) for figure in (first, self.second)]
        shift = (feet[0] - self._feet(transforms))[np.argmin((feet[0] + feet[1])[:, 1])]
        shift[1] = first.posed[:, 1].min() - posed[:, 1].min()
        transforms[:, :, 3] += shift
        return replace(first, transforms=transforms, posed=posed + shift)

    def _local(self, rotations: np.ndarray) -> Rotation:
        """Rotations [b] relative to the parents, from rotations [b, 3, 3] relative to the world."""
        parents = self.body.bone_parents
        above = np.where(parents[:, None, None] >= 0, rotations[parents], np.eye(3))
        return Rotation.from_matrix(above.transpose(0, 2, 1) @ rotations)

    def _feet(self, transforms: np.ndarray) -> np.ndarray:
        bones = [self.body.bone("toe2-1.L"), self.body.bone("toe2-1.R")]
        rotations, shifts = transforms[bones, :, :3], transforms[bones, :, 3]
        return np.einsum("bij,bj->bi", rotations, self.first.joints[bones]) + shifts


def generate_moving(seed: int, index: int, instants: int, active: bool = False) -> Person:
    """Person ``index`` of the family ``seed`` at all instants: parts and bodies of one instant after another.
    Arguments as of :func:`.people.generate`; the frame is that of the first instant."""
    person = Character(seed, index, active)
    first = person.first
    for _ in range(MAX_POSES):  # until the arms do not cut the trunk on the way
        second = pose_figure(person.body, person.coefficients, person.motion_rng, active)
        motion = Motion(person.body, first, second)
        if max(arm_depth(motion.at(share).posed, first.faces) for share in (0.25, 0.5, 0.75)) < 0.012:
            break
    figures = [first, *(motion.at(share) for share in shares(instants)[1:])]
    parts = person.dressed(first, occluding_spheres(first))
    unshaded, count = (np.empty((0, 3)), np.empty(0)), len(parts)
    for figure in figures[1:]:
        moved = zip(parts[:count], person.dressed(figure, unshaded), strict=True)
        parts += [replace(part, vertices=like.vertices) for part, like in moved]
    return person.placed(parts, np.concatenate([figure.posed for figure in figures]), count)
