"""Hair (a shell over the scalp, a curtain that falls from it, a ponytail, a bun) and knitted caps."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from ghgs_people.figures.blending import bump, smoothstep
from ghgs_people.figures.body import BODY_VERTICES, load_body, skin
from ghgs_people.figures.charts import chart
from ghgs_people.figures.complexion import Complexion
from ghgs_people.figures.fabric import Fabric, paint
from ghgs_people.figures.garments import Figure, push_out
from ghgs_people.figures.mesh import TexturedMesh
from ghgs_people.figures.meshing import triangles, vertex_normals
from ghgs_people.figures.place import face_frame, hairline

STYLES = ("bald", "crop", "short", "quiff", "afro", "bob", "long", "tail", "bun")
SHARES = {  # by sex (True: female), in the order of the styles
    True: (0.0, 0.03, 0.09, 0.03, 0.08, 0.22, 0.28, 0.16, 0.11),
    False: (0.07, 0.30, 0.28, 0.18, 0.08, 0.02, 0.04, 0.02, 0.01),
}
ROWS = 56
COLUMNS = 80


@dataclass(frozen=True)
class Haircut:
    """A haircut."""

    style: str
    thickness: float  # of the shell in metres
    end: float  # height on the average body where a curtain ends, metres
    wave: float  # how wavy the strands are, 0 to 1


def sample_haircut(rng: np.random.Generator, female: bool) -> Haircut:
    """Sample a haircut.

    Args:
        rng: samples everything.
        female: selects the entry of `SHARES`.
    """
    style = str(rng.choice(STYLES, p=SHARES[female]))
    thickness = {
        "bald": 0.0, "crop": rng.uniform(0.006, 0.012), "short": rng.uniform(0.014, 0.026),
        "quiff": rng.uniform(0.022, 0.034), "afro": rng.uniform(0.030, 0.065),
    }.get(style, rng.uniform(0.009, 0.014))  # fmt: skip
    end = rng.uniform(1.42, 1.48) if style == "bob" else rng.uniform(1.16, 1.36)
    return Haircut(style, thickness, end, rng.uniform(0, 1))


def make_hair(figure: Figure, cut: Haircut, look: Complexion, rng: np.random.Generator) -> list[TexturedMesh]:
    """Create the hair in the pose.

    Args:
        figure: the person.
        cut: its haircut.
        look: its colours.
        rng: samples place and size of a ponytail or bun.

    Returns:
        Meshes; empty for a bald head.
    """
    if cut.style == "bald":
        return []
    if cut.style in ("bob", "long"):
        return [_curtain(figure, cut, look)]
    parts = [_shell(figure, cut, look)]
    if cut.style in ("tail", "bun"):
        parts.append(_tail(figure, cut, look, rng))
    return parts


def _strands(look: Complexion, across: np.ndarray, along: np.ndarray, curl: float) -> np.ndarray:
    """Colour hair with streaks along the strands.

    Args:
        look: colours of the person.
        across: [k] metres across the strands.
        along: [k] metres along them.
        curl: strength of curls, 0 to 1.

    Returns:
        Colours [k, 3].
    """
    streak = look.fine(across / 0.10, along / 1.6) + 0.7 * look.fine(across / 0.28 + 0.3, along / 2.5)
    clump = look.noise(across / 0.30, along / 0.8)
    curls = look.fine(across / 0.14, along / 0.14) if curl else 0.0
    shade = 0.92 + 0.15 * streak + 0.10 * clump + 0.18 * curl * curls
    tint = look.hair + np.array([0.06, 0.04, 0.02])
    return tint * np.clip(shade, 0.35, 1.8)[:, None]


def _shell(figure: Figure, cut: Haircut, look: Complexion) -> TexturedMesh:
    """Displace the scalp outwards, thinning towards the hairline."""
    piece = chart("scalp")
    point = piece.place.point
    above = hairline(point)
    points = piece.interpolation @ figure.rest
    normals = vertex_normals(points, piece.point_faces)
    for _ in range(6):
        normals = piece.smooth @ normals
    centred = point - [0.0, 1.585, 0.105]
    azimuth = np.arctan2(centred[:, 0], centred[:, 2])
    polar = np.arctan2(np.hypot(centred[:, 0], centred[:, 2]), centred[:, 1])
    up = smoothstep(1.55, 1.66, point[:, 1])
    grow = smoothstep(-0.004, {"afro": 0.05, "crop": 0.03}.get(cut.style, 0.035), above)
    height = cut.thickness * grow
    if cut.style == "short":
        height = height * (0.55 + 0.6 * up)
    elif cut.style == "quiff":
        front = smoothstep(-0.02, 0.09, centred[:, 2])
        height = height * (0.30 + 0.55 * up + 0.60 * up * front * smoothstep(0.0, 0.02, above))
    strands = look.noise(azimuth / 1.2, polar / 3.0)
    rough = (
        look.fine(azimuth / 2.2, polar / 2.2)
        if cut.style == "afro"
        else look.noise(azimuth / 0.5, polar / 2.0)
    )
    height = height * np.clip(1 + 0.10 * strands + 0.10 * rough, 0.6, 1.4)
    lean = np.array([0.0, 0.12, -0.25]) if cut.style in ("short", "quiff") else np.zeros(3)
    points = points + height[:, None] * (normals + lean) + 0.0012 * normals
    posed = skin(points, piece.weights, figure.transforms)
    texel = piece.texel_place.point - [0.0, 1.585, 0.105]
    angle = np.arctan2(texel[:, 0], texel[:, 2])
    down = np.arctan2(np.hypot(texel[:, 0], texel[:, 2]), texel[:, 1])
    colour = _strands(look, angle * 0.09, down * 0.09, 1.0 if cut.style == "afro" else 0.25)
    edge = hairline(piece.texel_place.point)
    colour = colour * (0.72 + 0.28 * smoothstep(0.0, 0.035, edge))[:, None]
    ragged = above + 0.0035 * look.fine(azimuth / 0.9, polar / 0.9)
    return piece.mesh(posed, ragged + 0.002, piece.image(colour))


def _grid_faces(rows: int, columns: int) -> np.ndarray:
    index = np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], -1).reshape(-1, 4)
    return triangles(quads)


def _grid_mesh(
    figure: Figure, points: np.ndarray, weights: np.ndarray, clearance: float, texture: np.ndarray
) -> TexturedMesh:
    """Skin a grid, keeping it outside of the body.

    Args:
        figure: the person.
        points: [rows, columns, 3] at rest, metres.
        weights: [rows * columns, b] skinning weights.
        clearance: least distance from the body at rest, metres; 0.6 of it in the pose.
        texture: [h, w, 3] uint8 over the whole grid, row 0 at its top.
    """
    rows, columns, _ = points.shape
    naked = figure.rest[:BODY_VERTICES]
    air = np.full(rows * columns, clearance)
    flat = push_out(points.reshape(-1, 3), naked, vertex_normals(naked, figure.faces), air)
    posed = skin(flat, weights, figure.transforms)
    posed = push_out(posed, figure.posed, vertex_normals(figure.posed, figure.faces), 0.6 * air)
    v, u = np.meshgrid(np.linspace(1, 0, rows), np.linspace(0, 1, columns), indexing="ij")
    uv = np.stack([u.ravel(), v.ravel()], 1).astype(np.float32)
    return TexturedMesh(posed.astype(np.float32), _grid_faces(rows, columns), uv, texture)


def _hanging_weights(heights: np.ndarray, neck: float) -> np.ndarray:
    """Skinning weights of hair: the head's above the neck, the chest's below.

    Args:
        heights: [n] at rest, metres.
        neck: height of the neck, metres.

    Returns:
        [n, b].
    """
    body = load_body()
    weights = np.zeros((len(heights), len(body.bone_names)))
    chest = smoothstep(neck, neck - 0.16, heights)
    weights[:, body.bone("head")] = 1 - chest
    weights[:, body.bone("spine01")] = chest
    return weights


def _texture(look: Complexion, wave: float, length: float) -> np.ndarray:
    """Texture [512, 512, 3] uint8 of strands that run from top to bottom.

    Args:
        look: colours of the person.
        wave: waviness, 0 to 1.
        length: length of the strands, metres.
    """
    v, u = np.meshgrid((np.arange(512) + 0.5) / 512, (np.arange(512) + 0.5) / 512, indexing="ij")
    swing = 0.012 * wave * np.sin(2 * np.pi * (3.0 * v + 0.25 * look.noise(2 * u, 0.5 * v)))
    colour = _strands(look, (0.5 * u + swing).ravel(), (length * v).ravel(), 0.1)
    root = 0.80 + 0.20 * smoothstep(0.0, 0.25, v.ravel())
    return np.rint(255 * np.clip(colour * root[:, None], 0, 1)).astype(np.uint8).reshape(512, 512, 3)


def _curtain(figure: Figure, cut: Haircut, look: Complexion) -> TexturedMesh:
    """Create hair that grows from the crown in all directions and falls behind and beside the neck."""
    centre, scale, radius_at = _skull(figure)
    columns = np.linspace(-1, 1, COLUMNS)
    half = ROWS // 2
    drop = scale * (1.575 - cut.end)
    polar = np.concatenate([np.radians(np.linspace(2, 92, half)), np.full(ROWS - half, np.pi / 2 + 0.03)])
    fall = np.concatenate([np.zeros(half), np.linspace(0, drop, ROWS - half + 1)[1:]])
    height = 1.575 + np.where(fall > 0, -fall / scale, 0.100 * np.cos(polar))  # on the average head
    angle = np.pi + np.radians(180 - _face(height))[:, None] * columns
    polar = np.tile(polar[:, None], (1, COLUMNS))
    fall = fall[:, None] * (
        1 + 0.05 * look.noise(columns * 0.8, 0.2 * np.ones(COLUMNS)) * fall[:, None] / drop
    )
    direction = np.stack([np.sin(angle) * np.sin(polar), np.cos(polar), np.cos(angle) * np.sin(polar)], -1)
    part = 0.004 * np.exp(-((np.abs(columns) - 1) ** 2) / 0.002)
    volume = cut.thickness * smoothstep(0.02, 0.5, polar) + 0.005 - part
    strands = look.noise(columns * 0.9, np.full(COLUMNS, 0.4)) * 0.003 * smoothstep(0.3, 1.2, polar)
    points = centre + (radius_at(direction) + volume + strands)[..., None] * direction
    points[..., 1] -= fall
    phase = fall / 0.11 + 0.6 * look.noise(columns, 0.7 * np.ones(COLUMNS))
    swing = 0.012 * cut.wave * np.sin(2 * np.pi * phase) * smoothstep(0.0, 0.06, fall)
    inward = 0.25 * np.clip(fall - 0.02, 0, 0.12)
    points += swing[..., None] * (direction * [1, 0, 1]) - inward[..., None] * (direction * [0.6, 0, 1])
    neck = figure.joints[load_body().bone("neck01"), 1] + 0.03
    weights = _hanging_weights(points[..., 1].ravel(), neck)
    return _grid_mesh(figure, points, weights, 0.008, _texture(look, cut.wave, 0.3 + drop))


def _skull(figure: Figure) -> tuple[np.ndarray, float, Callable[[np.ndarray], np.ndarray]]:
    """Centre [3] of the cranium, its size relative to the average, and a function of its radius along
    directions [..., 3]."""
    piece = chart("head")
    upper = piece.place.y > 1.50
    head = (piece.interpolation @ figure.rest)[upper]
    mean = piece.place.point[upper]
    scale = np.ptp(head[:, 1]) / np.ptp(mean[:, 1])
    centre = head.mean(0) + (np.array([0.0, 1.575, 0.100]) - mean.mean(0)) * scale
    radii = np.linalg.norm(head - centre, axis=1)
    tree = cKDTree((head - centre) / radii[:, None])

    def radius_at(direction: np.ndarray) -> np.ndarray:
        """Radius [...] along unit vectors [..., 3], a mean of the 12 nearest vertices."""
        distance, index = tree.query(direction.reshape(-1, 3), k=12)
        weight = 1 / (distance + 0.06) ** 2
        return ((radii[index] * weight).sum(1) / weight.sum(1)).reshape(direction.shape[:-1])

    return centre, float(scale), radius_at


def _face(height: np.ndarray) -> np.ndarray:
    """Half angle in degrees of the face without hair, at heights of the average head."""
    return np.interp(height, [1.44, 1.552, 1.572, 1.600, 1.622, 1.634, 1.64], [98, 84, 74, 60, 42, 12, 0.5])


def make_beanie(figure: Figure, fabric: Fabric) -> TexturedMesh:
    """Create a knitted cap down to the ears, with the brim turned up.

    Args:
        figure: the wearer.
        fabric: fabric of the cap.
    """
    piece = chart("scalp")
    points = piece.interpolation @ figure.rest
    for _ in range(12):
        points = piece.smooth @ points
    at = face_frame(piece.place.point)
    above = at[:, 1] - 1.610 - 0.30 * (at[:, 2] - 0.2)
    height = 0.019 + 0.006 * (1 - smoothstep(0.040, 0.046, above)) + 0.010 * smoothstep(0.03, 0.1, above)
    points = points + height[:, None] * vertex_normals(points, piece.point_faces)
    texel = face_frame(piece.texel_place.point)
    azimuth = np.arctan2(texel[:, 0], texel[:, 2] - 0.105)
    rise = texel[:, 1] - 1.610 - 0.30 * (texel[:, 2] - 0.2)
    colour = paint(fabric, azimuth * 0.09, rise) * (1 - 0.35 * bump(rise, 0.043, 0.004))[:, None]
    return piece.mesh(skin(points, piece.weights, figure.transforms), above, piece.image(colour))


def under_hat(cut: Haircut) -> Haircut:
    """Flatten a haircut for wear below a hat."""
    style = cut.style if cut.style in ("bald", "bob", "long") else "crop"
    return Haircut(style, min(cut.thickness, 0.007), cut.end, cut.wave)


def _tail(figure: Figure, cut: Haircut, look: Complexion, rng: np.random.Generator) -> TexturedMesh:
    """Create a ponytail or a bun at the back of the head.

    Args:
        figure: the person.
        cut: haircut of style ``tail`` or ``bun``.
        look: colours of the person.
        rng: samples position and size.
    """
    body = load_body()
    skull = body.mean[:BODY_VERTICES]
    anchor = int(np.argmin(np.linalg.norm(skull - [0.0, rng.uniform(1.57, 1.64), 0.0], axis=1)))
    root = figure.rest[anchor] + [0, 0, 0.004 - cut.thickness]
    t = np.linspace(0, 1, 26)
    if cut.style == "bun":
        size = rng.uniform(0.034, 0.048)
        line = root + np.stack([0 * t, 0.3 * size * t, -1.7 * size * t], 1)
        width = size * np.sqrt(np.clip(1 - (2 * t - 1) ** 2, 0, 1)) + 0.001
    else:
        length = rng.uniform(0.22, 0.38)
        back = 0.055 * np.minimum(1, 4 * t) ** 0.6 - 0.02 * t
        line = root + np.stack(
            [0 * t, 0.02 * np.sin(np.pi * np.minimum(1, 3 * t)) - length * t**1.25, -back], 1
        )
        width = 0.030 * (0.35 + np.minimum(1, 3.5 * t)) * (1 - t**4 * 0.85)
    step = np.gradient(line, axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    side = np.tile([1.0, 0, 0], (len(t), 1))
    out = np.cross(side, step)
    angle = np.linspace(0, 2 * np.pi, 24)
    bumps = 1 + 0.06 * look.noise(
        np.cos(angle)[None] * 0.3, t[:, None] * (2.0 if cut.style == "bun" else 0.3)
    )
    ring = np.cos(angle)[None, :, None] * side[:, None] + np.sin(angle)[None, :, None] * out[:, None]
    points = line[:, None] + (width[:, None] * bumps)[..., None] * ring
    weights = np.zeros((points.shape[0] * points.shape[1], len(body.bone_names)))
    weights[:, body.bone("head")] = 1.0
    return _grid_mesh(figure, points, weights, 0.002, _texture(look, cut.wave, 0.4))
