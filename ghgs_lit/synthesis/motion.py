"""Built-in people in motion: from one pose to another and back, at instants of 1/30 s.

A person in motion is the still one of the same number, in its pose at the first instant. Only vertices move:
faces, texture coordinates and textures (with the shadows of the first instant) are those of all instants.
"""

from copy import deepcopy
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ghgs_lit.synthesis.people.ambient_occlusion import Spheres, occluding_spheres
from ghgs_lit.synthesis.people.body import BODY_VERTICES, BodyModel, bone_transforms, load_body, skin
from ghgs_lit.synthesis.people.complexion import sample_complexion
from ghgs_lit.synthesis.people.garments import Figure
from ghgs_lit.synthesis.people.generate import MAX_POSES, MAX_YAW, arm_depth, dress, pose_figure, skin_part
from ghgs_lit.synthesis.people.hair import make_beanie, make_hair, sample_haircut, under_hat
from ghgs_lit.synthesis.people.mesh import Person, TexturedMesh
from ghgs_lit.synthesis.people.outfit import sample_outfit

#: Part of the keys of caches: increase it when people of the same number would move differently.
VERSION = 1
#: Instants from one pose to the other: a second.
PASSAGE = 30


def instant_names(person: str, instants: int) -> tuple[str, ...]:
    """The subjects that a person is in the data: one an instant; 0 instants: one of the person's name."""
    return tuple(f"{person}_t{i:03d}" for i in range(instants)) or (person,)


def shares(instants: int) -> np.ndarray:
    """How far [instants] a person is from the first pose (0) to the second (1): evenly but at the poses."""
    even = 0.95  # at 1 a person would turn back at once
    return 0.5 - np.arcsin(even * np.cos(np.pi * np.arange(instants) / PASSAGE)) / (2 * np.arcsin(even))


@dataclass(frozen=True)
class Motion:
    """The motion between two figures of one shape."""

    body: BodyModel
    first: Figure
    second: Figure

    def at(self, share: float) -> Figure:
        """The figure at a share of the way. Each bone turns about one axis of its parent's; the foot that is
        lower in both poses stays where it is, and the lower foot of each instant on the ground."""
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
        """Rotations [b] relative to those of the parents, of world-axis ones [b, 3, 3]."""
        parents = self.body.bone_parents
        above = np.where(parents[:, None, None] >= 0, rotations[parents], np.eye(3))
        return Rotation.from_matrix(above.transpose(0, 2, 1) @ rotations)

    def _feet(self, transforms: np.ndarray) -> np.ndarray:
        """Where the balls of both feet are [2, 3]."""
        bones = [self.body.bone("toe2-1.L"), self.body.bone("toe2-1.R")]
        rotations, shifts = transforms[bones, :, :3], transforms[bones, :, 3]
        return np.einsum("bij,bj->bi", rotations, self.first.joints[bones]) + shifts


def generate_moving(seed: int, index: int, instants: int, active: bool = False) -> Person:
    """Person ``index`` of the family ``seed`` at all instants: parts and bodies one instant after another.
    Arguments and frame as for :func:`.people.generate`; the frame is that of the first instant."""
    # The streams of a still person, and one for the second pose.
    streams = [np.random.default_rng(s) for s in np.random.SeedSequence([seed, index]).spawn(5)]
    shape_rng, pose_rng, cloth_rng, look_rng, motion_rng = streams
    body = load_body()
    coefficients, female, age = body.sample_shape(shape_rng)
    first = pose_figure(body, coefficients, pose_rng, active)
    outfit, look = sample_outfit(cloth_rng, female), sample_complexion(look_rng, female, age)
    cut = sample_haircut(look_rng, female)
    cut = under_hat(cut) if outfit.beanie else cut

    def dressed(figure: Figure, spheres: Spheres) -> list[TexturedMesh]:
        scalp = 0.25 if cut.style == "bald" else 1.0
        parts = [skin_part(figure, outfit, look, spheres, scalp)]
        parts += dress(figure, outfit, spheres, deepcopy(cloth_rng))
        parts += make_hair(figure, cut, look, deepcopy(look_rng))
        parts += [make_beanie(figure, outfit.beanie)] if outfit.beanie else []
        return [part for part in parts if len(part.faces)]

    for _ in range(MAX_POSES):  # until the arms are clear of the trunk on the way
        motion = Motion(body, first, pose_figure(body, coefficients, motion_rng, active))
        if max(arm_depth(motion.at(share).posed, first.faces) for share in (0.25, 0.5, 0.75)) < 0.012:
            break
    figures = [first, *(motion.at(share) for share in shares(instants)[1:])]
    parts = dressed(first, occluding_spheres(first))
    unshaded, count = (np.empty((0, 3)), np.empty(0)), len(parts)
    for figure in figures[1:]:
        moved = zip(parts[:count], dressed(figure, unshaded), strict=True)
        parts += [replace(part, vertices=like.vertices) for part, like in moved]
    turn = Rotation.from_euler("y", pose_rng.uniform(-MAX_YAW, MAX_YAW), degrees=True).as_matrix()
    origin = 0.5 * (first.posed.min(0) + first.posed.max(0))
    origin[1] = min(float(part.vertices[:, 1].min()) for part in parts[:count])
    name = f"{'active' if active else 'person'}_{seed}_{index:04d}"
    person = Person(name, tuple(parts), np.concatenate([figure.posed for figure in figures]))
    return person.mapped(lambda vertices: (vertices - origin) @ turn.T)
