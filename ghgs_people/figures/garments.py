"""Shapes of garments: their edges (fields on the average body) and their draping over a posed body."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d, map_coordinates
from scipy.spatial import cKDTree

from ghgs_people.figures.blending import bump, smoothstep
from ghgs_people.figures.body import BODY_VERTICES, load_body, skin
from ghgs_people.figures.charts import Chart, chart
from ghgs_people.figures.meshing import vertex_normals
from ghgs_people.figures.noise import Noise
from ghgs_people.figures.outfit import Bottom, Shoes, Top
from ghgs_people.figures.place import CROTCH, Place

ANKLE = 0.120  # height above which the surface that trousers are cut from is complete, metres
SOLE = 0.013  # thickness of a sole, metres


@dataclass(frozen=True)
class Figure:
    """A naked person in a pose."""

    rest: np.ndarray  # [n, 3] vertices of the base mesh at rest, metres
    joints: np.ndarray  # [b, 3] at rest
    faces: np.ndarray  # [m, 3] triangles of the skin
    transforms: np.ndarray  # [b, 3, 4] of the bones from rest to pose
    posed: np.ndarray  # [BODY_VERTICES, 3] vertices of the skin in the pose


# ---- edges of garments: signed distance to the edge in metres, positive on cloth


def neckline(place: Place, kind: str) -> np.ndarray:
    """Field of a neckline.

    Args:
        place: places of n points.
        kind: crew, scoop, vee, collar or straps.

    Returns:
        [n] metres below the neckline, negative above.
    """
    back, slope, radius, rise = {
        "crew": (1.422, 0.50, 0.072, 0.03),
        "scoop": (1.410, 0.82, 0.088, 0.05),
        "straps": (1.412, 0.80, 0.076, 0.06),
        "vee": (1.422, 0.50, 0.074, 0.03),
        "collar": (1.448, 0.46, 0.066, 0.03),
    }[kind]
    line = back - slope * (place.z - 0.03) + rise * (np.abs(place.x) / radius) ** 4
    field = line - place.y
    if kind in ("vee", "collar"):
        depth, slope = (1.27, 0.42) if kind == "vee" else (1.335, 0.40)
        wedge = (np.abs(place.x) - slope * (place.y - depth)) * 0.9
        field = np.where((place.z > 0.07) & (place.y > depth - 0.05), np.minimum(field, wedge), field)
    return field


def top_field(place: Place, top: Top) -> np.ndarray:
    """Field of a top or a jacket.

    Args:
        place: places of n points.
        top: the garment.

    Returns:
        [n] metres from its edge, positive where the garment is.
    """
    hem = place.y - top.hem + 2.0 * place.arm
    sleeve = top.sleeve - place.sleeve
    if top.kind == "tank":  # armholes run from the shoulder strap to under the arm
        sleeve = top.sleeve + 0.25 * np.clip(1.30 - place.y, 0, 0.2) - np.abs(place.x) - 0.5 * place.arm
        sleeve = np.where(place.y > 1.19, sleeve, 0.03 - 0.2 * place.arm)
    field = np.minimum(np.minimum(hem, sleeve), neckline(place, top.neck))
    if top.opening:
        gap = np.abs(place.x) - top.opening * (0.6 + 0.5 * smoothstep(1.25, 0.9, place.y))
        field = np.where((place.z > 0.08) & (place.arm < 0.5), np.minimum(field, gap), field)
    return field


def bottom_field(place: Place, bottom: Bottom) -> np.ndarray:
    """Field of trousers or a skirt.

    Args:
        place: places of n points.
        bottom: the garment.

    Returns:
        [n] metres from its edge, positive where the garment is.
    """
    hem = bottom.hem if bottom.kind == "skirt" else max(bottom.hem, ANKLE)
    return np.minimum(np.minimum(bottom.waist - place.y, place.y - hem), 0.5 - place.arm)


def shoe_field(place: Place, shoes: Shoes) -> np.ndarray:
    """Field of shoes, which are low in front of the ankle and higher at the heel.

    Args:
        place: places of n points.
        shoes: the shoes.

    Returns:
        [n] metres from their upper edge, positive where shoes are.
    """
    instep = smoothstep(0.06, 0.13, place.z)
    return shoes.top - place.y + 0.02 * instep + 0.008 * np.cos(place.leg_angle)


# ---- draping


def push_out(
    points: np.ndarray, vertices: np.ndarray, normals: np.ndarray, clearance: np.ndarray
) -> np.ndarray:
    """Move points outwards to a minimum distance from a body.

    Args:
        points: [g, 3], metres.
        vertices: [n, 3], vertices of the body, metres.
        normals: [n, 3], unit normals of the body.
        clearance: [g], least distance along the normal of the nearest vertex, metres.

    Returns:
        [g, 3]; no point moves more than 4 cm.
    """
    _, index = cKDTree(vertices).query(points)
    height = np.einsum("gi,gi->g", points - vertices[index], normals[index])
    lack = np.clip(clearance - height, 0.0, 0.04)
    return points + lack[:, None] * normals[index]


def drape_top(figure: Figure, top: Top, noise: Noise) -> np.ndarray:
    """Drape a top or a jacket.

    Args:
        figure: the wearer.
        top: the garment.
        noise: noise of its folds.

    Returns:
        Points [g, 3] of the upper chart in the pose, metres.
    """
    piece = chart("upper")
    place = piece.place
    points = piece.interpolation @ figure.rest
    sleeve_end = smoothstep(top.sleeve - 0.20, top.sleeve, place.sleeve) * (top.kind != "tank")
    flare = {"tee": 0.012, "shirt": 0.007, "jacket": 0.006}.get(top.kind, 0.0) if top.sleeve < 0.4 else -0.004
    ease = top.ease + flare * sleeve_end * place.arm
    folds = _wrinkles(place, noise, top)
    if top.tucked:  # flat below the waistband, loose above it
        out = smoothstep(0.985, 1.03, place.y)
        ease = out * (ease + 0.008 * bump(place.y, 1.05, 0.03)) + 0.001 * (1 - out)
        folds = out * folds
    else:  # over the waistband of trousers or skirt
        low = max(1.02, top.hem + 0.03)
        ease = np.maximum(ease, 0.0145 * (1 - smoothstep(low, low + 0.06, place.y)))
    points = points + (ease + folds)[:, None] * vertex_normals(points, piece.point_faces)
    points = _hang(points, place, top.hang * smoothstep(0.985, 1.03, place.y) if top.tucked else top.hang)
    return _pose(figure, piece, points, np.minimum(0.4 * ease + 0.002, ease + 0.001))


def fold_collar(posed: np.ndarray, top: Top) -> tuple[np.ndarray, np.ndarray]:
    """Fold a collar down over its shirt.

    Args:
        posed: points [g, 3] of the shirt in the pose, metres.
        top: the shirt.

    Returns:
        Points [g, 3] of the upper chart in the pose, and the collar's field [g], both in metres.
    """
    piece = chart("upper")
    below = neckline(piece.place, top.neck)
    lift = 0.004 + 0.006 * smoothstep(0.0, 0.03, below)
    points = posed + lift[:, None] * vertex_normals(posed, piece.point_faces)
    depth = 0.036 + 0.022 * bump(np.abs(piece.place.x), 0.045, 0.022) * (piece.place.z > 0.07)
    field = np.minimum(below, depth - below)
    return points, np.minimum(field, piece.place.y - 1.33)


def _wrinkles(place: Place, noise: Noise, top: Top) -> np.ndarray:
    """Height [g] of the folds of a top in metres: across the sleeve at the elbow,
    slanted at the waist."""
    loose = 0.5 + 30.0 * top.ease
    around = np.where(place.arm > 0.5, place.arm_angle * 0.05, place.trunk_angle * 0.15)
    bends = noise(around / 0.9 + 0.31, np.where(place.arm > 0.5, place.sleeve, place.y) / 0.42)
    slant = noise(place.x / 0.8 + place.y / 0.7, (place.y - 0.6 * np.abs(place.x)) / 0.55)
    elbow = place.arm * (
        0.0022 + 0.0042 * bump(place.sleeve, 0.25, 0.10) + 0.004 * bump(place.sleeve, 0.44, 0.06)
    )
    waist = (1 - place.arm) * (0.0016 + 0.0045 * bump(place.y, 1.0, 0.10) + 0.002 * bump(place.y, 1.25, 0.08))
    return loose * (elbow * bends + waist * slant)


def _hang(points: np.ndarray, place: Place, share: np.ndarray | float) -> np.ndarray:
    """Let cloth hang from chest, shoulder blades and belly over the hollows below.

    Args:
        points: [g, 3] at rest, metres.
        place: places of the points.
        share: fraction of the cloth that hangs, 0 to 1; one number or [g].

    Returns:
        [g, 3].
    """
    trunk = place.arm < 0.3
    axis = np.array([0.0, np.median(points[trunk, 2])])
    offset = points[:, [0, 2]] - axis
    radius = np.hypot(*offset.T)
    angle = np.arctan2(offset[:, 0], offset[:, 1])
    rows = 28
    columns = 36
    top = points[trunk & (place.y < 1.30), 1].max()
    bottom = points[trunk, 1].min()
    row = np.clip((top - points[:, 1]) / (top - bottom) * (rows - 1), 0, rows - 1)
    column = (angle / (2 * np.pi) % 1.0) * columns
    cell = np.rint(row).astype(int) * columns + np.rint(column).astype(int) % columns
    chosen = trunk & (points[:, 1] <= top)
    grid = np.zeros(rows * columns)
    np.maximum.at(grid, cell[chosen], radius[chosen])
    grid = grid.reshape(rows, columns)
    fall = (top - bottom) / rows * 0.10  # narrows by 10 cm per metre
    for below in range(1, rows):
        grid[below] = np.maximum(grid[below], grid[below - 1] - fall)
    grid = gaussian_filter1d(gaussian_filter1d(grid, 1.2, axis=1, mode="wrap"), 1.0, axis=0, mode="nearest")
    grid = np.concatenate([grid, grid[:, :1]], 1)  # the last column is the first
    hung = map_coordinates(grid, [row, column], order=1, mode="nearest")
    gain = np.clip(hung - radius, 0.0, 0.06) * share * (1 - smoothstep(0.05, 0.4, place.arm))
    gain *= smoothstep(0.0, 3.0, row)
    moved = points.copy()
    moved[:, [0, 2]] += gain[:, None] * offset / np.maximum(radius, 1e-6)[:, None]
    return moved


def drape_trousers(figure: Figure, bottom: Bottom, noise: Noise) -> np.ndarray:
    """Drape trousers, leggings or shorts.

    Args:
        figure: the wearer.
        bottom: the garment.
        noise: noise of its folds.

    Returns:
        Points [g, 3] of the lower chart in the pose, metres.
    """
    piece = chart("lower")
    place = piece.place
    points = piece.interpolation @ figure.rest
    tight = bottom.kind == "leggings"
    waist = smoothstep(bottom.waist - 0.10, bottom.waist, place.y)
    ease = 0.003 if tight else 0.0085 - 0.003 * waist
    bends = noise(place.leg_angle * 0.07 / 0.9, place.y / 0.45)
    slant = noise(place.x / 0.7, (place.y + 0.7 * np.abs(place.x)) / 0.5)
    creases = 0.0015 + 0.005 * bump(place.y, 0.50, 0.09) + 0.005 * bump(place.y, 0.19, 0.05)
    crotch = 0.004 * bump(place.y, 0.80, 0.08)
    folds = (0.25 if tight else 1.0) * (creases * bends * (place.y < 0.95) + crotch * slant)
    points = points + (ease + folds)[:, None] * vertex_normals(points, piece.point_faces)
    if not tight:
        points = _widen_legs(figure, points, place, bottom, folds)
    # the helper surface ends at the ankle; the hem falls on the shoe
    drop = max(ANKLE - bottom.hem, 0.0)
    points[:, 1] -= drop * (1 - smoothstep(ANKLE, 0.24, place.y))
    clearance = np.where(place.y < 0.15, -1.0, 0.002)  # the hem may touch the foot
    return _pose(figure, piece, points, clearance)


def _widen_legs(
    figure: Figure, points: np.ndarray, place: Place, bottom: Bottom, folds: np.ndarray
) -> np.ndarray:
    """Widen each leg to the radius of its cut: a straight tube from the thigh to the hem.

    Args:
        figure: the wearer.
        points: [g, 3] of the lower chart at rest, metres.
        place: places of the points.
        bottom: the garment.
        folds: [g] height of folds, metres.

    Returns:
        [g, 3] at rest.
    """
    body = load_body()
    joints = [figure.joints[body.bone(f"{name}.L")] for name in ("upperleg01", "lowerleg01", "foot")]
    moved = points.copy()
    for side in (1.0, -1.0):
        leg = np.flatnonzero((place.side == side) & (place.y < CROTCH))
        line = np.array([[side * j[0], j[1], j[2]] for j in joints])
        centre = np.stack([np.interp(-points[leg, 1], -line[:, 1], line[:, i]) for i in (0, 2)], 1)
        offset = points[leg][:, [0, 2]] - centre
        radius = np.hypot(*offset.T)
        thigh = radius[np.abs(place.y[leg] - 0.69) < 0.03].mean()
        hem = thigh + bottom.width if bottom.kind == "shorts" else bottom.width
        cut = np.interp(place.y[leg], [bottom.hem, 0.70, CROTCH], [hem, 0.94 * thigh, 0.0])
        wanted = np.maximum(radius, cut + folds[leg])
        moved[leg[:, None], [0, 2]] = centre + offset * (wanted / np.maximum(radius, 1e-6))[:, None]
        moved[leg, 0] = side * np.maximum(side * moved[leg, 0], 0.006)
    return moved


def drape_skirt(figure: Figure, bottom: Bottom, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """Drape a skirt, flared towards the hem, with folds.

    Args:
        figure: the wearer.
        bottom: the garment.
        noise: noise of the folds' course.
        rng: samples number and depth of the folds.

    Returns:
        Points [g, 3] of the skirt chart in the pose, metres.
    """
    piece = chart("skirt")
    place = piece.place
    points = piece.interpolation @ figure.rest
    down = np.clip(0.93 - place.y, 0.0, 0.8)
    axis = points[:, [0, 2]].mean(0)
    offset = points[:, [0, 2]] - axis
    angle = np.arctan2(offset[:, 0], offset[:, 1])
    count = int(rng.integers(7, 15))
    wander = 1.2 * noise(angle / (2 * np.pi), np.full_like(angle, 0.3))
    folds = np.cos(count * angle + wander) * rng.uniform(0.03, 0.11) * down
    slim = 1 - 0.35 * (1 - bottom.width / 0.55) * smoothstep(0.0, 0.5, down)
    grown = 1 + bottom.width * down + folds
    points[:, [0, 2]] = axis + offset * (slim * grown)[:, None]
    points = points + 0.010 * vertex_normals(points, piece.point_faces)
    return _pose(figure, piece, points, np.full(len(points), 0.006))


def shape_shoes(figure: Figure, shoes: Shoes) -> np.ndarray:
    """Shape shoes with rounded toes and a flat sole below the foot.

    Args:
        figure: the wearer.
        shoes: the shoes.

    Returns:
        Points [g, 3] of the shoe chart in the pose, metres.
    """
    piece = chart("shoes")
    place = piece.place
    points = piece.interpolation @ figure.rest
    normals = vertex_normals(points, piece.point_faces)
    normals[:, 1] *= 0.6
    points = points + 0.008 * normals
    toe = smoothstep(0.16, 0.26, place.z) * smoothstep(0.02, 0.06, place.y + 0.02)
    points[:, 1] += 0.006 * toe
    sole = 1 - smoothstep(0.003, 0.017, place.y)
    points[:, 1] = points[:, 1] * (1 - sole) - SOLE * sole
    if shoes.kind == "leather":
        points[:, 1] -= 0.004 * sole * (place.z < 0.10)
    return _pose(figure, piece, points, np.where(place.y > 0.03, 0.003, -1.0))


def _pose(figure: Figure, piece: Chart, points: np.ndarray, clearance: np.ndarray) -> np.ndarray:
    """Pose a garment by its skinning weights, moving it out of the body before and after.

    Args:
        figure: the wearer.
        piece: its chart.
        points: [g, 3] at rest, metres.
        clearance: [g], least distance from the body, metres; negative where it may be inside.

    Returns:
        [g, 3] in the pose.
    """
    bare = figure.rest[:BODY_VERTICES]
    points = push_out(points, bare, vertex_normals(bare, figure.faces), clearance)
    posed = skin(points, piece.weights, figure.transforms)
    posed = push_out(posed, figure.posed, vertex_normals(figure.posed, figure.faces), clearance)
    return piece.smooth @ posed
