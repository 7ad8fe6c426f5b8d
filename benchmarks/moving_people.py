"""Built-in people in motion, rendered in memory: from one pose to another and back, at instants of 1/30 s. At
the first instant a person in motion equals the still one of the same number. Only vertices move: faces,
texture coordinates and textures (with the shadows of the first instant) are the same at all instants."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from ghgs_lit.data.reader import Reader
from ghgs_lit.data.sampling import subject_rng
from ghgs_lit.data.view import View
from ghgs_people.figures.ambient_occlusion import occluding_spheres
from ghgs_people.figures.body import BODY_VERTICES, BodyModel, bone_transforms, skin
from ghgs_people.figures.garments import Figure
from ghgs_people.figures.generate import MAX_POSES, Character, arm_depth, pose_figure
from ghgs_people.figures.mesh import Person
from ghgs_people.jobs import LIGHTS, RenderOptions, photographs
from ghgs_people.photograph import Studio
from ghgs_people.rig import Rig

#: Instants from one pose to the other: one second.
PASSAGE = 30
# Vertices that are followed over all instants.
_FOLLOWED = 4000


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
        """The figure at a share of the way. Each bone turns about a fixed axis of its parent; the
        foot that is lower in both poses stays in its place, the lowest vertex on the ground."""
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
    """Person ``index`` of the family ``seed`` at all instants: parts and bodies of one instant
    after another. Arguments as of :func:`ghgs_people.figures.generate`; the frame is that of the
    first instant."""
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


class MovingPerson(Reader):
    """Photographs of a built-in person at all instants, each a subject ``<person>_t<number>``.
    ``surfaces``: points [n, 3] of the surface, the same at all instants."""

    def __init__(self, person: str, instants: int, rig: Rig, settings: RenderOptions, seed: int = 0) -> None:
        super().__init__()
        rng = subject_rng(seed, person)
        moving = rig.place(generate_moving(seed, int(person[1:]), instants, person.startswith("a")), rng)
        yaws, lights = rig.yaws(rng), LIGHTS.draw(rng)
        height, width = settings.size
        drawn, poses = rig.drawn(moving, yaws, width / height, rng.spawn(1)[0])
        self.surfaces: dict[str, np.ndarray] = {}
        self._views: dict[tuple[str, int, int], View] = {}
        count = len(moving.parts) // instants
        for i in range(instants):
            name, parts = f"{person}_t{i:03d}", moving.parts[i * count : (i + 1) * count]
            studio = Studio(replace(moving, parts=parts), lights, settings.samples)
            lights = studio.lights  # the exposure of the first instant
            shot = {(p, n): view for p, n, view in photographs(studio, drawn, settings, yaws, poses)}
            self._views |= {(name, *place): view for place, view in shot.items()}
            self.subjects[name] = tuple(dict.fromkeys(position for position, _ in shot))
            vertices = np.concatenate([part.vertices for part in parts])
            self.surfaces[name] = vertices[np.linspace(0, len(vertices) - 1, _FOLLOWED).astype(int)]

    def read_view(self, name: str, position: int, view: int, depth: bool) -> View:
        return self._views[name, position, view]

    def read_body(self, name: str) -> None:
        return None
