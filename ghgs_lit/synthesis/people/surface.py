"""Where a point of the body or of a garment lies: charts of the base mesh, in the average body at rest.

A chart is the part of a surface that shares one texture. Its texels and vertices know their place on the
average body (`Place`), so that patterns, seams, hems and necklines are functions of the place, the same for
every shape.
"""

from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import numpy as np
from scipy import sparse

from ghgs_lit.synthesis.people.body import BodyModel, load_body
from ghgs_lit.synthesis.people.mesh import TexturedMesh
from ghgs_lit.synthesis.people.meshing import clip, neighbour_mean, rasterise, subdivide, triangles
from ghgs_lit.synthesis.people.noise import smoothstep

CROTCH = 0.766  # height of the average body's crotch, metres
EYE = np.array([0.0288, 1.5661, 0.1909])  # centre of the left eye in the frame that faces are described in
FEET_UV = 0.9068  # in the UV layout of the helper garment the feet lie below


@dataclass(frozen=True)
class Place:
    """Points on the average body at rest, n of them, float32.

    Attributes:
        point: [n, 3] metres.
        arm: [n] 0 on the trunk, 1 on an arm.
        sleeve: [n] metres from the shoulder joint along the arm; at most 0 on the trunk.
        side: [n] +1 left, -1 right.
        trunk_angle, arm_angle, leg_angle: [n] around the axis, 0 in front, positive outwards (trunk: left).
    """

    point: np.ndarray
    arm: np.ndarray
    sleeve: np.ndarray
    side: np.ndarray
    trunk_angle: np.ndarray
    arm_angle: np.ndarray
    leg_angle: np.ndarray

    @property
    def x(self) -> np.ndarray:
        return self.point[:, 0]

    @property
    def y(self) -> np.ndarray:
        return self.point[:, 1]

    @property
    def z(self) -> np.ndarray:
        return self.point[:, 2]


def locate(point: np.ndarray, arm_weight: np.ndarray) -> Place:
    """Place of points [n, 3] of the average body, given the skinning weight [n] of the arm bones."""
    body = load_body()
    joints = body.mean[body.vertex_count :]
    side = np.where(point[:, 0] >= 0, 1.0, -1.0)
    folded = point * np.stack([side, np.ones_like(side), np.ones_like(side)], 1)
    arm = smoothstep(0.1, 0.55, arm_weight)
    along, radial = _along(
        folded, [joints[body.bone(n + ".L")] for n in ("upperarm01", "lowerarm01", "wrist")]
    )
    sleeve = np.where(arm_weight > 0.02, along * arm, np.minimum(along, 0.0))
    arm_angle = np.arctan2(radial @ [0.74, 0.67, 0.0], radial @ [0.0, 0.0, 1.0])
    legs = [joints[body.bone(n + ".L")] for n in ("upperleg01", "lowerleg01", "foot")]
    centre = np.stack(
        [np.interp(-folded[:, 1], [-j[1] for j in legs], [j[i] for j in legs]) for i in (0, 2)], 1
    )
    # Above the legs each panel of a garment turns about its own half of the trunk.
    centre[:, 0] += smoothstep(CROTCH - 0.1, 0.95, folded[:, 1]) * (0.09 - centre[:, 0])
    leg_angle = np.arctan2(folded[:, 0] - centre[:, 0], folded[:, 2] - centre[:, 1])
    trunk_angle = np.arctan2(point[:, 0] / 1.45, point[:, 2] - 0.09)
    values = (point, arm, sleeve, side, trunk_angle, arm_angle, leg_angle)
    return Place(*(value.astype(np.float32) for value in values))


def _along(points: np.ndarray, line: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Length along a line of joints, and offset from it, of points [n, 3]; its ends go on straight."""
    best, start = None, 0.0
    for index, (a, b) in enumerate(pairwise(line)):
        length = np.linalg.norm(b - a)
        direction = (b - a) / length
        t = (points - a) @ direction
        low = -np.inf if index == 0 else 0.0
        high = np.inf if index == len(line) - 2 else length
        t = np.clip(t, low, high)
        offset = points - a - t[:, None] * direction
        distance = np.linalg.norm(offset, axis=1)
        if best is None:
            best = (distance, start + t, offset)
        else:
            nearer = distance < best[0]
            best = (
                np.where(nearer, distance, best[0]),
                np.where(nearer, start + t, best[1]),
                np.where(nearer[:, None], offset, best[2]),
            )
        start += length
    return best[1], best[2]


def face_frame(point: np.ndarray) -> np.ndarray:
    """Points [n, 3] of the average head, moved up or down and to and fro so that the left eye is at `EYE`."""
    body = load_body()
    eyes = body.mean[np.unique(body.surfaces["eyes"].quads)]
    return point + (EYE - eyes[eyes[:, 0] > 0].mean(0)) * [0, 1, 1]


def hairline(point: np.ndarray) -> np.ndarray:
    """Metres above the hairline (positive on the scalp) for points [n, 3] of the average head."""
    point = face_frame(point)
    angle = np.degrees(np.arctan2(np.abs(point[:, 0]), point[:, 2] - 0.105))
    line = np.interp(
        angle,
        [0, 25, 42, 55, 66, 78, 88, 100, 118, 135, 155, 180],
        [1.634, 1.632, 1.622, 1.600, 1.572, 1.552, 1.566, 1.586, 1.556, 1.520, 1.492, 1.486],
    )
    return point[:, 1] - line


def _ear_corners(body: BodyModel) -> np.ndarray:
    """Which corners [t] of the UV layout lie on the ears."""
    height, width, _ = body.head_masks.shape
    uv = _cropped(body.uv, tuple(body.head_uv))
    inside = ((uv > 0) & (uv < 1)).all(1)
    column = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    row = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return inside & (body.head_masks[row, column, 2] > 128)


@dataclass(frozen=True)
class Chart:
    """A surface with one texture.

    Attributes:
        operator: [g, n] sparse, from the vertices of the base mesh to the g points of the surface.
        weights: [g, b] skinning weights.
        smooth: [g, g] sparse, one step of smoothing.
        vertex_faces: [m, 3] over the g points.
        corner: [c] the point of each textured vertex; faces: [m, 3] and uv: [c, 2] over those.
        place: of the g points; shape: height and width of the texture.
        texels, nearest: covered texels [k], nearest covered one of each texel; texel_place: of the k texels.
        texel_points, texel_shares: the points [k, 3] that a texel lies between, their shares [k, 3].
    """

    operator: sparse.csr_matrix
    weights: np.ndarray
    smooth: sparse.csr_matrix
    vertex_faces: np.ndarray
    corner: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    place: Place
    shape: tuple[int, int]
    texels: np.ndarray
    nearest: np.ndarray
    texel_place: Place
    texel_points: np.ndarray
    texel_shares: np.ndarray

    def image(self, colours: np.ndarray) -> np.ndarray:
        """Texture [h, w, 3] uint8 from colours [k, 3] in [0, 1] of the covered texels, bled over the rest."""
        return np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)[self.nearest].reshape(*self.shape, 3)

    def shaded(self, texture: np.ndarray, factor: np.ndarray) -> np.ndarray:
        """A texture [h, w, 3] times a factor [g] of the points."""
        factor = factor.astype(np.float32)[self.texel_points]
        spread = np.einsum("kc,kc->k", factor, self.texel_shares)[self.nearest].reshape(*self.shape, 1)
        return np.rint(np.minimum(texture * spread, 255)).astype(np.uint8)

    def mesh(self, points: np.ndarray, field: np.ndarray, texture: np.ndarray) -> TexturedMesh:
        """The surface at `points` [g, 3] where `field` [g] is positive."""
        faces, a, b, t = clip(self.faces, field[self.corner])
        share = t[:, None]
        corners = points[self.corner]
        vertices = (1 - share) * corners[a] + share * corners[b]
        uv = (1 - share) * self.uv[a] + share * self.uv[b]
        return TexturedMesh(vertices.astype(np.float32), faces, uv.astype(np.float32), texture)


def _chart(
    quads: np.ndarray,
    uv_quads: np.ndarray,
    uv: np.ndarray,
    shape: tuple[int, int],
    levels: int = 0,
    smoothing: int = 0,
    blending: int = 0,
) -> Chart:
    """Build a chart of base-mesh quads [m, 4] with UV numbers [m, 4] into `uv` [t, 2].

    The quads are split `levels` times, the points smoothed `smoothing`, the weights `blending` times.
    """
    body = load_body()
    used, local = np.unique(quads, return_inverse=True)
    quads = local.reshape(-1, 4)
    operator = sparse.csr_matrix(
        (np.ones(len(used)), (np.arange(len(used)), used)), (len(used), body.vertex_count)
    )
    uv_used, uv_local = np.unique(uv_quads, return_inverse=True)
    uv, uv_quads = uv[uv_used].astype(np.float64), uv_local.reshape(-1, 4)
    for _ in range(levels):
        finer, fine_quads = subdivide(quads, operator.shape[0])
        operator = finer @ operator
        finer, uv_quads = subdivide(uv_quads, len(uv))
        uv, quads = finer @ uv, fine_quads
    smooth = neighbour_mean(quads, operator.shape[0])
    for _ in range(smoothing):
        operator = smooth @ operator
    vertex_faces = triangles(quads)
    pairs, corners = np.unique(
        np.stack([vertex_faces.ravel(), triangles(uv_quads).ravel()], 1), axis=0, return_inverse=True
    )
    faces = corners.reshape(-1, 3)
    uv = uv[pairs[:, 1]]
    weights = operator @ body.weights
    arm_bones = ("upperarm", "lowerarm", "wrist", "finger")
    arm_weight = weights[:, [name.startswith(arm_bones) for name in body.bone_names]].sum(1)
    for _ in range(blending):
        weights = smooth @ weights
    points = operator @ body.mean[: body.vertex_count]
    texels, face, bary, nearest = rasterise(uv, faces, *shape)
    blend = pairs[:, 0][faces[face]]
    texel_points = np.einsum("kc,kci->ki", bary, points[blend])
    texel_arm = np.einsum("kc,kc->k", bary, arm_weight[blend])
    return Chart(
        operator.tocsr(),
        weights,
        smooth,
        vertex_faces,
        pairs[:, 0],
        faces,
        uv,
        locate(points, arm_weight),
        shape,
        texels,
        nearest,
        locate(texel_points, texel_arm),
        blend.astype(np.int32),
        bary.astype(np.float32),
    )


def _cropped(uv: np.ndarray, box: tuple[float, float, float, float]) -> np.ndarray:
    """UV relative to a box (left, bottom, right, top)."""
    left, bottom, right, top = box
    return (uv - [left, bottom]) / [right - left, top - bottom]


@cache
def chart(name: str) -> Chart:
    """The charts, built once a process: head, scalp, skin, eyes, upper, lower, skirt, shoes."""
    body = load_body()
    if name in ("head", "skin"):
        surface = body.surfaces["body"]
        uv = _cropped(body.uv, tuple(body.head_uv))
        inside = ((uv > 0) & (uv < 1)).all(1)[surface.uv_quads].all(1)
        inside &= body.mean[surface.quads][..., 1].min(1) > 1.38  # the fingers' island lies close by
        if name == "head":
            return _chart(surface.quads[inside], surface.uv_quads[inside], uv, (968, 512))
        return _chart(surface.quads[~inside], surface.uv_quads[~inside], body.uv, (640, 640))
    if name == "scalp":
        surface = body.surfaces["body"]
        above = hairline(body.mean[: body.vertex_count])[surface.quads]
        chosen = (above.min(1) > -0.03) & (body.mean[surface.quads][..., 1].min(1) > 1.44)
        chosen &= ~_ear_corners(body)[surface.uv_quads].any(1)
        box = (*body.uv[surface.uv_quads[chosen]].min((0, 1)), *body.uv[surface.uv_quads[chosen]].max((0, 1)))
        return _chart(
            surface.quads[chosen], surface.uv_quads[chosen], _cropped(body.uv, box), (640, 384), 2, 4
        )
    if name == "eyes":
        surface = body.surfaces["eyes"]
        box = (*body.uv[surface.uv_quads].min((0, 1)), *body.uv[surface.uv_quads].max((0, 1)))
        return _chart(surface.quads, surface.uv_quads, _cropped(body.uv, box), (64, 128))
    if name == "skirt":
        surface = body.surfaces["skirt"]
        box = (*body.uv[surface.uv_quads].min((0, 1)), *body.uv[surface.uv_quads].max((0, 1)))
        return _chart(surface.quads, surface.uv_quads, _cropped(body.uv, box), (512, 768), 1, 2, 24)
    surface = body.surfaces["tights"]
    height = body.mean[surface.quads][..., 1]
    ankle = body.uv[surface.uv_quads][..., 1].max(1) < FEET_UV
    arms = body.mean[surface.quads][..., 0]
    if name == "shoes":
        chosen, shape = ankle, (224, 512)
    elif name == "lower":
        chosen, shape = ~ankle & (height.max(1) < 1.12) & (np.abs(arms).max(1) < 0.30), (704, 768)
    else:
        chosen, shape = ~ankle & (height.min(1) > 0.70), (736, 832)
    uv_quads = surface.uv_quads[chosen]
    box = (*(body.uv[uv_quads].min((0, 1)) - 0.0004), *(body.uv[uv_quads].max((0, 1)) + 0.0004))
    return _chart(
        surface.quads[chosen],
        uv_quads,
        _cropped(body.uv, box),
        shape,
        1,
        *((2, 5) if name != "shoes" else (4, 2)),
    )
