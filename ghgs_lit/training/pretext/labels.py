"""Parts of the built-in body, from its skinning weights, and the parts that patches show."""

from functools import cache

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ghgs_lit.errors import require
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.synthesis.people.body import BODY_VERTICES, load_body
from ghgs_lit.types import Batch, Tokens

# Prefixes of the names of a part's bones. Bones of limbs end with .L or .R, and their sides are two parts.
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


def parts_of_points(points: Float[Tensor, "n 3"], vertices: Float[Tensor, "m 3"]) -> Int[Tensor, " n"]:
    """The body part of each world point on clothes, hair or skin: that of the nearest vertex of the skin.
    ``vertices``: of the posed body [:data:`BODY_VERTICES`, 3]. InputError: not those of a built-in body."""
    expected = f"{BODY_VERTICES}, all of a built-in person (data=synthetic)"
    require(len(vertices) == BODY_VERTICES, "vertices of the body", expected, len(vertices))
    # For one batch: a tree that is quick to build, not the quickest to query.
    tree = cKDTree(vertices.double().cpu().numpy(), balanced_tree=False, compact_nodes=False)
    nearest = tree.query(points.double().cpu().numpy())[1]
    return torch.from_numpy(vertex_parts()[nearest]).to(points.device)


def has_parts(batch: Batch) -> bool:
    """Whether the bodies of a batch are built-in ones, whose parts are known."""
    bodies = batch.body_vertices or ()
    return len(bodies) > 0 and all(len(body) == BODY_VERTICES for body in bodies)


def token_parts(shares: Float[Tensor, "n P"], tokens: Tokens) -> Int[Tensor, " N"]:
    """The part with the largest of ``shares`` (:func:`part_shares`) in the patch of each token; -1: none."""
    _, _, h, w = tokens.grid
    own = shares[(tokens.image * h + tokens.row) * w + tokens.column]
    return torch.where(own.any(1), own.argmax(1), -1)


def part_shares(batch: Batch, patch_size: int) -> Float[Tensor, "n P"]:
    """Shares of :data:`PARTS` among the subject's pixels of each patch, ordered by image, row and column; 0
    without such a pixel. ``batch``: with true depths and vertices of built-in bodies; sides are divisible by
    the patch size. InputError: no depths, no bodies, or other bodies."""
    require(batch.depths is not None, "data", "true depths, which the labels are made from", "none")
    require(batch.body_vertices is not None, "data", "people with bodies, as data=synthetic", "none")
    b, v, height, width = batch.depths.shape
    valid, points = batch.masks & (batch.depths > 0), unproject_maps(batch.depths, batch.cameras)
    found = torch.cat(
        [parts_of_points(points[i][valid[i]], body) for i, body in enumerate(batch.body_vertices)]
    )
    grid = (b, v, height // patch_size, width // patch_size)
    numbers = torch.arange(grid[0] * grid[1] * grid[2] * grid[3], device=found.device)
    patch = F.interpolate(numbers.view(grid).double(), scale_factor=patch_size).long()[valid]
    counts = torch.bincount(patch * len(PARTS) + found, minlength=len(numbers) * len(PARTS))
    counts = counts.view(-1, len(PARTS)).float()
    return counts / counts.sum(1, keepdim=True).clamp_min(1)
