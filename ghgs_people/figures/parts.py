"""Parts of the built-in body, from its skinning weights."""

from functools import cache
from typing import ClassVar

import numpy as np

from ghgs_lit.training.pretext import PARTS, BodyParts
from ghgs_people.figures.body import BODY_VERTICES, load_body

# Prefixes of the names of a part's bones. Bones of limbs end with .L or .R,
# and their sides are two parts.
_TRUNK = {
    "head": ("head", "neck"),
    "chest": ("spine01", "spine02", "clavicle", "shoulder"),
    "abdomen": ("spine03", "spine04"),
    "hips": ("spine05", "root"),
}
_LIMBS = {
    "upper arm": ("upperarm",),
    "forearm": ("lowerarm",),
    "hand": ("wrist", "finger"),
    "thigh": ("upperleg",),
    "shin": ("lowerleg",),
    "foot": ("foot", "toe"),
}


def _part_of(bone: str) -> str:
    """Name the part of the body that a bone belongs to.

    Args:
        bone: its name.

    Returns:
        One of ``PARTS``.
    """
    for name, beginnings in _TRUNK.items():
        if bone.startswith(beginnings):
            return name
    side = {"L": "left", "R": "right"}[bone[-1]]
    return next(f"{side} {name}" for name, beginnings in _LIMBS.items() if bone.startswith(beginnings))


@cache
def vertex_parts() -> np.ndarray:
    """The part of each vertex of the skin [n]: that with the largest total weight of its bones."""
    body = load_body()
    weights = np.zeros((BODY_VERTICES, len(PARTS)))
    for bone, name in enumerate(body.bone_names):
        weights[:, PARTS.index(_part_of(name))] += body.weights[:BODY_VERTICES, bone]
    return weights.argmax(1)


class BuiltInParts(BodyParts):
    """Parts of the vertices of built-in people."""

    vertices: ClassVar[int] = BODY_VERTICES

    def of_vertices(self) -> np.ndarray:
        return vertex_parts()
