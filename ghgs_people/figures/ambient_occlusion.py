"""Ambient occlusion of a person by their own body and the ground.

The body is approximated by spheres inside trunk and limbs, because the fraction of light that a sphere
blocks has a closed form (about cos(angle) (radius / distance)^2). Folds and hollows finer than the spheres
are found from the distance between the surface and a smoothed copy of it. Both are smooth functions of the
points, unlike an estimate from random rays.
"""

import numpy as np
from scipy.spatial import cKDTree

from ghgs_people.figures.body import BODY_VERTICES, load_body
from ghgs_people.figures.charts import Chart
from ghgs_people.figures.garments import Figure
from ghgs_people.figures.meshing import vertex_normals

CHAINS = (  # from joint, to joint, number of spheres
    ("upperleg01", "lowerleg01", 6), ("lowerleg01", "foot", 6), ("foot", "toe2-1", 2),
    ("upperarm01", "lowerarm01", 5), ("lowerarm01", "wrist", 5), ("wrist", "finger3-1", 2),
)  # fmt: skip
TRUNK = ("root", "spine05", "spine04", "spine03", "spine02", "spine01", "neck01", "neck03", "head")
Spheres = tuple[np.ndarray, np.ndarray]  # centres [s, 3], radii [s], metres
STRENGTH = 0.75  # strength of the shadows of spheres
HOLLOW = 45.0  # fraction of the light that a hollow loses per metre of depth


def occluding_spheres(figure: Figure) -> Spheres:
    """Place spheres inside trunk and limbs that touch the skin from inside.

    Args:
        figure: the naked person.

    Returns:
        Centres [s, 3] in the pose and radii [s], metres.
    """
    body = load_body()
    naked = figure.rest[:BODY_VERTICES]
    centres = []
    bones = []
    for end in (".L", ".R"):
        for start, stop, count in CHAINS:
            a = body.bone(start + end)
            b = body.bone(stop + end)
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


def visibility(points: np.ndarray, normals: np.ndarray, spheres: Spheres) -> np.ndarray:
    """Fraction of the surroundings, weighted by the cosine, that spheres and the ground do not hide.

    Args:
        points: [g, 3], metres, the ground at y = 0.
        normals: [g, 3], unit vectors.
        spheres: centres [s, 3] and radii [s], metres.

    Returns:
        [g] from 0 (dark) to 1.
    """
    light = np.ones(len(points))
    for centre, radius in zip(*spheres, strict=True):
        away = centre - points
        square = np.einsum("gi,gi->g", away, away)
        facing = np.clip(np.einsum("gi,gi->g", away, normals) / np.sqrt(np.maximum(square, 1e-12)), 0, None)
        light *= 1 - facing * np.minimum(radius**2 / np.maximum(square, 1e-12), 1.0)
    floor = 0.5 * (1 - normals[:, 1]) * np.exp(-np.maximum(points[:, 1], 0.0) / 0.12)
    return light * (1 - 0.5 * floor)


def ambient_occlusion(piece: Chart, points: np.ndarray, spheres: Spheres) -> np.ndarray:
    """Darken a chart where the body, the ground or hollows of the surface hide the surroundings.

    Args:
        piece: the chart.
        points: its points [g, 3] in the pose, metres.
        spheres: spheres of the body, in the pose.

    Returns:
        Factor [g] on the colours, slightly above 1 on ridges.
    """
    normals = vertex_normals(points, piece.point_faces)
    smooth = points
    for _ in range(5):
        smooth = piece.smooth @ smooth
    depth = np.einsum("gi,gi->g", smooth - points, normals)
    light = 1 - STRENGTH * (1 - visibility(points, normals, spheres))
    return light * (1 - np.clip(HOLLOW * depth, -0.10, 0.30))
