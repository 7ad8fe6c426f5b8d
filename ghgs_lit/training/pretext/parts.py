"""Parts of the built-in body, from its skinning weights."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.synthesis.people.body import BODY_VERTICES, load_body

# The beginnings of the names of a part's bones. Names end with .L and .R on limbs, whose sides are two parts.
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

PARTS = (*_TRUNK, *(f"{side} {name}" for name in _LIMBS for side in ("left", "right")))


def _part_of(bone: str) -> str:
    """The part that a bone moves."""
    for name, beginnings in _TRUNK.items():
        if bone.startswith(beginnings):
            return name
    side = {"L": "left", "R": "right"}[bone[-1]]
    return next(f"{side} {name}" for name, beginnings in _LIMBS.items() if bone.startswith(beginnings))


@cache
def vertex_parts() -> np.ndarray:
    """The part of each vertex of the skin [n]: the one whose bones have the largest weight together."""
    body = load_body()
    weights = np.zeros((BODY_VERTICES, len(PARTS)))
    for bone, name in enumerate(body.bone_names):
        weights[:, PARTS.index(_part_of(name))] += body.weights[:BODY_VERTICES, bone]
    return weights.argmax(1)


def parts_of_points(points: Float[Tensor, "n 3"], vertices: Float[Tensor, "m 3"]) -> Int[Tensor, " n"]:
    """The part of the body beneath each world point: that of the nearest vertex of the skin.

    Args:
        points: on clothes, hair or skin.
        vertices: of the posed body [:data:`BODY_VERTICES`, 3], in the same world.

    Raises:
        InputError: not the vertices of a built-in body.
    """
    expected = f"{BODY_VERTICES}, all of a built-in person (data=synthetic)"
    require(len(vertices) == BODY_VERTICES, "vertices of the body", expected, len(vertices))
    # Made for one batch: a tree that is quick to build, not the quickest to ask.
    tree = cKDTree(vertices.double().cpu().numpy(), balanced_tree=False, compact_nodes=False)
    nearest = tree.query(points.double().cpu().numpy())[1]
    return torch.from_numpy(vertex_parts()[nearest]).to(points.device)
