"""Parts of bodies that plug-ins know, and the parts that patches show."""

from functools import cache
from typing import ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from ghgs_lit.config import registry
from ghgs_lit.config.options import Options
from ghgs_lit.config.registry import class_of, kinds_of
from ghgs_lit.errors import require
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.types import Batch

#: Parts of a body that patches are labelled with.
PARTS = (
    "head", "chest", "abdomen", "hips",
    "left upper arm", "right upper arm", "left forearm", "right forearm", "left hand", "right hand",
    "left thigh", "right thigh", "left shin", "right shin", "left foot", "right foot",
)  # fmt: skip


class BodyParts(Options):
    """A body model whose vertices have known parts: a kind of ``parts``, which plug-ins offer."""

    vertices: ClassVar[int]
    """Number of vertices, by which bodies of the model are recognised."""

    def of_vertices(self) -> np.ndarray:
        """The part of each vertex [n], an index into :data:`PARTS`."""
        raise NotImplementedError


@cache
def _vertex_parts(vertices: int) -> np.ndarray | None:
    """Parts of the body model of so many vertices; None: no plug-in knows it."""
    for kind in kinds_of(registry.PARTS):
        body = class_of(registry.PARTS, kind, registry.PARTS)
        if body.vertices == vertices:
            return body().of_vertices()
    return None


def parts_of_points(points: Float[Tensor, "n 3"], vertices: Float[Tensor, "m 3"]) -> Int[Tensor, " n"]:
    """The body part of each world point on clothes, hair or skin:
    that of the nearest vertex of the skin.

    Args:
        points: in the unit of ``vertices``.
        vertices: of the posed body, all of them.

    Raises:
        InputError: no plug-in knows the parts of a body of so many vertices.
    """
    parts = _vertex_parts(len(vertices))
    expected = "those of a body whose parts are known, as of a built-in person (data=synthetic)"
    require(parts is not None, "vertices of the body", expected, len(vertices))
    # For one batch: a tree that is quick to build, not the quickest to query.
    tree = cKDTree(vertices.double().cpu().numpy(), balanced_tree=False, compact_nodes=False)
    nearest = tree.query(points.double().cpu().numpy())[1]
    return torch.from_numpy(parts[nearest]).to(points.device)


def part_shares(batch: Batch, patch_size: int) -> Float[Tensor, "n P"]:
    """Shares of :data:`PARTS` among the subject's pixels of each patch.

    Args:
        batch: with true depths and vertices of bodies whose parts are known; sides are divisible by
            the patch size.
        patch_size: side of a patch in pixels.

    Returns:
        Shares of each patch, ordered by image, row and column; 0 without a pixel of the subject.

    Raises:
        InputError: no depths, no bodies, or other bodies."""
    require(batch.depths is not None, "data", "true depths, which the labels are made from", "none")
    require(batch.body_vertices is not None, "data", "people with bodies, as data=synthetic", "none")
    b, v, height, width = batch.depths.shape
    valid = batch.masks & (batch.depths > 0)
    points = unproject_maps(batch.depths, batch.cameras)
    parts = []
    for element, body in enumerate(batch.body_vertices):
        parts.append(parts_of_points(points[element][valid[element]], body))
    labels = torch.cat(parts)
    grid = (b, v, height // patch_size, width // patch_size)
    numbers = torch.arange(grid[0] * grid[1] * grid[2] * grid[3], device=labels.device)
    patch = F.interpolate(numbers.view(grid).double(), scale_factor=patch_size).long()[valid]
    counts = torch.bincount(patch * len(PARTS) + labels, minlength=len(numbers) * len(PARTS))
    counts = counts.view(-1, len(PARTS)).float()
    return counts / counts.sum(1, keepdim=True).clamp_min(1)
