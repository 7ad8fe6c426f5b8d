"""Soft shadows that belong to the surface: how much of its surroundings a point sees past the person's body.

The body is a set of spheres inside trunk and limbs; what a sphere hides from a surface element is known in
closed form (about cos(angle) (radius / distance)^2 of its light). Folds and hollows finer than the spheres
come from the distance between the surface and its smoothed self. Both are smooth functions of the points,
unlike an estimate from random rays.
"""

import numpy as np
from scipy.spatial import cKDTree

from ghgs_lit.synthesis.people.body import BODY_VERTICES, load_body
from ghgs_lit.synthesis.people.charts import Chart
from ghgs_lit.synthesis.people.garments import Figure
from ghgs_lit.synthesis.people.meshing import vertex_normals

CHAINS = (  # from joint, to joint, spheres
    ("upperleg01", "lowerleg01", 6), ("lowerleg01", "foot", 6), ("foot", "toe2-1", 2),
    ("upperarm01", "lowerarm01", 5), ("lowerarm01", "wrist", 5), ("wrist", "finger3-1", 2),
)  # fmt: skip
TRUNK = ("root", "spine05", "spine04", "spine03", "spine02", "spine01", "neck01", "neck03", "head")
STRENGTH = 0.75  # of the spheres' shadow
HOLLOW = 45.0  # darkness per metre of depth of a hollow


def spheres(figure: Figure) -> tuple[np.ndarray, np.ndarray]:
    """Centres [s, 3] in the pose and radii [s] of spheres that touch the skin from inside."""
    body = load_body()
    naked = figure.rest[:BODY_VERTICES]
    centres, bones = [], []
    for end in (".L", ".R"):
        for start, stop, count in CHAINS:
            a, b = body.bone(start + end), body.bone(stop + end)
            for share in (np.arange(count) + 0.3) / count:
                centres.append((1 - share) * figure.joints[a] + share * figure.joints[b])
                bones.append(a)
    for name in TRUNK:
        joint = figure.joints[body.bone(name)]
        for across in (-0.075, 0.0, 0.075) if name.startswith(("root", "spine")) else (0.0,):
            centres.append([across, joint[1], max(joint[2], 0.06)])
            bones.append(body.bone(name))
    skull = naked[body.weights[:BODY_VERTICES, body.bone("head")] > 0.9]
    centres.append(0.5 * (skull.min(0) + skull.max(0)))
    bones.append(body.bone("head"))
    centres = np.array(centres)
    radii, _ = cKDTree(naked).query(centres)
    transforms = figure.transforms[bones]
    return np.einsum("sij,sj->si", transforms[:, :, :3], centres) + transforms[:, :, 3], radii


def surroundings(
    points: np.ndarray, normals: np.ndarray, centres: np.ndarray, radii: np.ndarray
) -> np.ndarray:
    """Share [g] of the surroundings, weighted by the cosine, that spheres and the ground leave free."""
    light = np.ones(len(points))
    for centre, radius in zip(centres, radii, strict=True):
        away = centre - points
        square = np.einsum("gi,gi->g", away, away)
        facing = np.clip(np.einsum("gi,gi->g", away, normals) / np.sqrt(np.maximum(square, 1e-12)), 0, None)
        light *= 1 - facing * np.minimum(radius**2 / np.maximum(square, 1e-12), 1.0)
    floor = 0.5 * (1 - normals[:, 1]) * np.exp(-np.maximum(points[:, 1], 0.0) / 0.12)
    return light * (1 - 0.5 * floor)


def shade(piece: Chart, points: np.ndarray, balls: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Factor [g] on the colours of a chart whose posed points [g, 3] are among the spheres `balls`."""
    normals = vertex_normals(points, piece.point_faces)
    smooth = points
    for _ in range(5):
        smooth = piece.smooth @ smooth
    depth = np.einsum("gi,gi->g", smooth - points, normals)
    light = 1 - STRENGTH * (1 - surroundings(points, normals, *balls))
    return light * (1 - np.clip(HOLLOW * depth, -0.10, 0.30))
