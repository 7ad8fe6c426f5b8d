"""UV charts of the base mesh: parts of body and garments that share one texture.

Each point and texel of a chart has a place on the average body (:mod:`ghgs_people.figures.place`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy import sparse

from ghgs_people.figures.body import BodyModel, Surface, load_body
from ghgs_people.figures.mesh import TexturedMesh
from ghgs_people.figures.meshing import clip, neighbour_mean, rasterise, subdivide, triangles
from ghgs_people.figures.place import Place, hairline, locate

FEET_UV = 0.9068  # v coordinate below which the helper garment's UV layout shows the feet


@dataclass(frozen=True)
class Chart:
    """A surface with one texture."""

    # [g, n] sparse, from the vertices of the base mesh to the g points of the surface
    interpolation: sparse.csr_matrix
    weights: np.ndarray  # [g, b] skinning weights
    smooth: sparse.csr_matrix  # [g, g] sparse, one step of Laplacian smoothing
    point_faces: np.ndarray  # [m, 3] triangles over the g points
    # [c] the point of each textured vertex (a point on a UV seam has several)
    point_of_vertex: np.ndarray
    faces: np.ndarray  # [m, 3] triangles over the c textured vertices
    uv: np.ndarray  # [c, 2] of the textured vertices
    place: Place  # of the g points
    shape: tuple[int, int]  # height and width of the texture
    texels: np.ndarray  # [k] flat numbers of the texels that the surface covers
    # [height * width] the position in `texels` of the covered texel nearest to each texel
    nearest: np.ndarray
    texel_place: Place  # of the k covered texels
    texel_points: np.ndarray  # [k, 3] the points of the triangle that a covered texel lies in
    texel_shares: np.ndarray  # [k, 3] its barycentric coordinates there

    def image(self, colours: np.ndarray) -> np.ndarray:
        """Create a texture from the colours of its covered texels; other texels copy the nearest one.

        Args:
            colours: [k, 3] in [0, 1].

        Returns:
            [h, w, 3] uint8.
        """
        return np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)[self.nearest].reshape(*self.shape, 3)

    def shade(self, texture: np.ndarray, factor: np.ndarray) -> np.ndarray:
        """Multiply a texture by a factor on the surface.

        Args:
            texture: [h, w, 3] uint8.
            factor: [g], factor at each point, at least 0.

        Returns:
            [h, w, 3] uint8.
        """
        factor = factor.astype(np.float32)[self.texel_points]
        spread = np.einsum("kc,kc->k", factor, self.texel_shares)[self.nearest].reshape(*self.shape, 1)
        return np.rint(np.minimum(texture * spread, 255)).astype(np.uint8)

    def mesh(self, points: np.ndarray, field: np.ndarray, texture: np.ndarray) -> TexturedMesh:
        """Cut the surface along the zero line of a field.

        Args:
            points: [g, 3], metres.
            field: [g], positive where the surface is kept.
            texture: [h, w, 3] uint8.
        """
        faces, a, b, t = clip(self.faces, field[self.point_of_vertex])
        vertices = np.concatenate([points[self.point_of_vertex], self.uv], 1)
        vertices = ((1 - t[:, None]) * vertices[a] + t[:, None] * vertices[b]).astype(np.float32)
        return TexturedMesh(vertices[:, :3], faces, vertices[:, 3:], texture)


@dataclass(frozen=True)
class _Recipe:
    """Parameters of a chart.

    `shape` is the height and width of the texture; quads are subdivided `levels` times, points are smoothed
    `smoothing` times and skinning weights `blending` times.
    """

    shape: tuple[int, int]
    levels: int = 0
    smoothing: int = 0
    blending: int = 0


RECIPES = {
    "head": _Recipe((968, 512)),
    "skin": _Recipe((640, 640)),
    "eyes": _Recipe((64, 128)),
    "scalp": _Recipe((640, 384), 2, 4),
    "upper": _Recipe((736, 832), 1, 2, 5),
    "lower": _Recipe((704, 768), 1, 2, 5),
    "skirt": _Recipe((512, 768), 1, 2, 24),
    "shoes": _Recipe((224, 512), 1, 4, 2),
}


@cache
def chart(name: str) -> Chart:
    """Build a chart, once per process.

    Args:
        name: one of `RECIPES`.
    """
    body = load_body()
    recipe = RECIPES[name]
    surface, box = _select(body, name)
    quads = surface.quads
    uv_quads = surface.uv_quads
    used, quads = np.unique(quads, return_inverse=True)
    quads = quads.reshape(-1, 4)
    ones = np.ones(len(used))
    rows = np.arange(len(used))
    interpolation = sparse.csr_matrix((ones, (rows, used)), (len(used), body.vertex_count))
    uv = _crop_charts(body.uv, box).astype(np.float64)
    for _ in range(recipe.levels):
        finer, quads = subdivide(quads, interpolation.shape[0])
        interpolation = finer @ interpolation
        finer, uv_quads = subdivide(uv_quads, len(uv))
        uv = finer @ uv
    smooth = neighbour_mean(quads, interpolation.shape[0])
    for _ in range(recipe.smoothing):
        interpolation = smooth @ interpolation
    point_faces = triangles(quads)
    pairs = np.stack([point_faces.ravel(), triangles(uv_quads).ravel()], 1)
    pairs, faces = np.unique(pairs, axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3)
    uv = uv[pairs[:, 1]]
    weights = interpolation @ body.weights
    arm_bones = ("upperarm", "lowerarm", "wrist", "finger")
    arm_weight = weights[:, [name.startswith(arm_bones) for name in body.bone_names]].sum(1)
    for _ in range(recipe.blending):
        weights = smooth @ weights
    points = interpolation @ body.mean[: body.vertex_count]
    texels, face, shares, nearest = rasterise(uv, faces, *recipe.shape)
    texel_points = pairs[:, 0][faces[face]]
    return Chart(
        interpolation=interpolation.tocsr(),
        weights=weights,
        smooth=smooth,
        point_faces=point_faces,
        point_of_vertex=pairs[:, 0],
        faces=faces,
        uv=uv,
        place=locate(points, arm_weight),
        shape=recipe.shape,
        texels=texels,
        nearest=nearest,
        texel_place=locate(
            np.einsum("kc,kci->ki", shares, points[texel_points]),
            np.einsum("kc,kc->k", shares, arm_weight[texel_points]),
        ),
        texel_points=texel_points.astype(np.int32),
        texel_shares=shares.astype(np.float32),
    )


def _select(body: BodyModel, name: str) -> tuple[Surface, Sequence[float]]:
    """Select the quads of a chart.

    Args:
        body: the base mesh.
        name: one of `RECIPES`.

    Returns:
        The quads, and the box (left, bottom, right, top) of the texture in the UV layout.
    """
    surface = body.surfaces["body"]
    margin = 0.0
    if name in ("head", "skin"):
        uv = _crop_charts(body.uv, body.head_uv)
        inside = ((uv > 0) & (uv < 1)).all(1)[surface.uv_quads].all(1)
        inside &= body.mean[surface.quads][..., 1].min(1) > 1.38  # the box also contains fingers
        return (surface[inside], body.head_uv) if name == "head" else (surface[~inside], (0, 0, 1, 1))
    if name == "scalp":
        above = hairline(body.mean[: body.vertex_count])[surface.quads]
        chosen = (above.min(1) > -0.03) & (body.mean[surface.quads][..., 1].min(1) > 1.44)
        surface = surface[chosen & ~_ear_corners(body)[surface.uv_quads].any(1)]
    elif name in ("eyes", "skirt"):
        surface = body.surfaces[name]
    else:
        surface = body.surfaces["tights"]
        margin = 0.0004
        x, y, _ = np.moveaxis(body.mean[surface.quads], -1, 0)
        foot = body.uv[surface.uv_quads][..., 1].max(1) < FEET_UV
        surface = surface[
            {
                "shoes": foot,
                "lower": ~foot & (y.max(1) < 1.12) & (np.abs(x).max(1) < 0.30),
                "upper": ~foot & (y.min(1) > 0.70),
            }[name]
        ]
    corners = body.uv[surface.uv_quads]
    return surface, (*(corners.min((0, 1)) - margin), *(corners.max((0, 1)) + margin))


def _crop_charts(uv: np.ndarray, box: Sequence[float]) -> np.ndarray:
    """UV coordinates relative to a box (left, bottom, right, top)."""
    left, bottom, right, top = box
    return (uv - [left, bottom]) / [right - left, top - bottom]


def _ear_corners(body: BodyModel) -> np.ndarray:
    """Which points [t] of the UV layout lie on the ears."""
    height, width, _ = body.head_masks.shape
    uv = _crop_charts(body.uv, body.head_uv)
    inside = ((uv > 0) & (uv < 1)).all(1)
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return inside & (body.head_masks[row, column, 2] > 128)
