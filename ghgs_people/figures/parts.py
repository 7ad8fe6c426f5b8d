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
    """Body part, one of ``PARTS``, of a bone by its name."""
    for name, beginnings in _TRUNK.items():
        if bone.startswith(beginnings):
            return name
    side = {"L": "left", "R": "right"}[bone[-1]]
    return next(f"{side} {name}" for name, beginnings in _LIMBS.items() if bone.startswith(beginnings))


@cache
def vertex_parts() -> np.ndarray:
    """Part [n] of each vertex of the skin: the one whose bones have the largest total weight."""
    body = load_body()
    weights = np.zeros((BODY_VERTICES, len(PARTS)))
    for bone, name in enumerate(body.bone_names):
        weights[:, PARTS.index(_part_of(name))] += body.weights[:BODY_VERTICES, bone]
    return weights.argmax(1)


class BuiltInParts(BodyParts):
    """Body parts of the vertices of built-in people."""

    vertices: ClassVar[int] = BODY_VERTICES

    def of_vertices(self) -> np.ndarray:
        return vertex_parts()
