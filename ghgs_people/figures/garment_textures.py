"""Textures of garments: patterns, seams, hems, pockets, buttons, belts, soles and laces."""

import numpy as np

from ghgs_people.figures.blending import bump, darken, mix, smoothstep
from ghgs_people.figures.charts import chart
from ghgs_people.figures.fabric import Fabric, paint, print_emblem
from ghgs_people.figures.garments import ANKLE, neckline
from ghgs_people.figures.noise import Noise
from ghgs_people.figures.outfit import Bottom, Shoes, Top
from ghgs_people.figures.place import Place


def _line(distance: np.ndarray, width: float) -> np.ndarray:
    """Mask of a line.

    Args:
        distance: [k], distance from the centre line, metres.
        width: distance beyond which the mask is 0, metres.

    Returns:
        Mask [k], 1 on the line.
    """
    return 1 - smoothstep(0.4 * width, width, np.abs(distance))


def _folds(across: np.ndarray, along: np.ndarray, noise: Noise, strength: np.ndarray) -> np.ndarray:
    """Shade folds: hollows are darker.

    Args:
        across: [k] metres around the body.
        along: [k] metres up it.
        noise: noise of the folds.
        strength: [k], relative strength of the shading.

    Returns:
        Factor [k] on the colours.
    """
    height = noise(across / 0.95 + 0.13, along / 0.45)
    return 1 + strength * np.clip(0.8 * height, -1.2, 0.5)


def top_texture(top: Top, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """Paint a top or a jacket.

    Args:
        top: the garment.
        noise: noise of its folds.
        rng: samples the emblem and the colour of the trim.

    Returns:
        Texture [h, w, 3] uint8 of the chart ``upper``.
    """
    piece = chart("upper")
    place = piece.texel_place
    on_arm = place.arm > 0.5
    across = np.where(on_arm, place.arm_angle * 0.052, place.trunk_angle * 0.15)
    along = np.where(on_arm, 1.31 - place.sleeve, place.y)
    colour = paint(top.fabric, across, along)
    if top.emblem in ("front", "both"):
        front = (place.z > 0.09) & (np.abs(place.x) < 0.15) & ~on_arm
        colour[front] = print_emblem(colour[front], place.x[front], place.y[front], (0.0, 1.21), rng)
    if top.emblem in ("back", "both"):
        back = (place.z < 0.05) & (np.abs(place.x) < 0.16) & ~on_arm
        colour[back] = print_emblem(colour[back], -place.x[back], place.y[back], (0.0, 1.24), rng)
    edge = np.minimum(
        neckline(place, top.neck),
        np.where(on_arm, top.sleeve - place.sleeve, 1.0) if top.kind != "tank" else 1.0,
    )
    if not top.tucked:
        edge = np.minimum(edge, np.where(on_arm, 1.0, place.y - top.hem))
    colour = _trim(colour, edge, top, rng)
    if top.kind in ("shirt", "jacket"):
        colour = _front_closure(colour, place, top, on_arm)
    colour = darken(colour, _line(place.arm - 0.5, 0.10) * (place.y > 1.15), 0.12)  # armhole seam
    strength = 0.04 + 0.09 * on_arm * bump(place.sleeve, 0.25, 0.10)
    strength = strength + 0.06 * ~on_arm * bump(place.y, 1.0, 0.12)
    shade = _folds(across, along, noise, strength)
    armpit = [(np.abs(place.x) - 0.165) / 0.035, (place.y - 1.235) / 0.05, (place.z - 0.06) / 0.05]
    shade = shade * (1 - 0.25 * np.exp(-np.square(armpit).sum(0)))
    return piece.image(colour * shade[:, None])


def _trim(colour: np.ndarray, edge: np.ndarray, top: Top, rng: np.random.Generator) -> np.ndarray:
    """Paint ribs or a stitched hem along all edges.

    Args:
        colour: [k, 3] in [0, 1].
        edge: [k] distance to the nearest edge, metres.
        top: the garment.
        rng: samples whether the trim has its own colour.

    Returns:
        Colours [k, 3].
    """
    if top.kind in ("tee", "tank"):
        if rng.random() < 0.25:
            colour = mix(colour, 1 - smoothstep(0.013, 0.015, edge), top.fabric.colours[1])
        return darken(colour, _line(edge - 0.017, 0.0022), 0.28)
    if top.kind == "sweater":
        band = 1 - smoothstep(0.030, 0.033, edge)
        if rng.random() < 0.3:
            colour = mix(colour, band, top.fabric.colours[1])
        return darken(darken(colour, band, 0.10), _line(edge - 0.032, 0.003), 0.25)
    return darken(colour, _line(edge - 0.008, 0.002), 0.22)


def _front_closure(colour: np.ndarray, place: Place, top: Top, on_arm: np.ndarray) -> np.ndarray:
    """Paint placket, buttons and chest pocket of a shirt, or the zip edge of a jacket.

    Args:
        colour: [k, 3] in [0, 1].
        place: places of the k texels.
        top: the garment.
        on_arm: [k] bool, texels of sleeves.

    Returns:
        Colours [k, 3].
    """
    front = (place.z > 0.08) & ~on_arm
    if top.opening:
        return darken(colour, _line(np.abs(place.x) - top.opening - 0.014, 0.003) * front, 0.3)
    for at in (-0.014, 0.014):
        colour = darken(colour, _line(place.x - at, 0.0022) * front, 0.25)
    row = (place.y - 0.02) / 0.085
    button = np.hypot(place.x, (row - np.rint(row)) * 0.085)
    ink = np.full(3, 0.9) if top.fabric.colours[0].mean() < 0.5 else np.full(3, 0.25)
    colour = mix(colour, (1 - smoothstep(0.0042, 0.0056, button)) * front, ink)
    pocket = np.maximum(np.abs(place.x - 0.075) - 0.042, np.abs(place.y - 1.235) - 0.05)
    return darken(colour, _line(pocket, 0.0025) * front, 0.3)


def bottom_texture(bottom: Bottom, noise: Noise) -> np.ndarray:
    """Paint trousers or a skirt.

    Args:
        bottom: the garment.
        noise: noise of its folds.

    Returns:
        Texture [h, w, 3] uint8 of the chart ``lower``, or ``skirt`` for a skirt.
    """
    if bottom.kind == "skirt":
        return _skirt_texture(bottom, noise)
    piece = chart("lower")
    place = piece.texel_place
    across = place.side * place.leg_angle * np.interp(place.y, [0.62, 0.95], [0.08, 0.115])
    if bottom.kind == "jeans":
        colour = _denim(bottom.fabric, across, place, noise)
    else:
        colour = paint(bottom.fabric, across, place.y)
    colour = darken(colour, _line(place.leg_angle - np.pi / 2, 0.035), 0.2)
    if bottom.kind != "leggings":
        colour = _pockets(colour, place, bottom)
    edge = np.minimum(place.y - max(bottom.hem, ANKLE), bottom.waist - place.y)
    colour = darken(colour, _line(edge - 0.016, 0.0025), 0.25)
    band = _line(np.clip(place.y - bottom.waist + 0.018, -1, 1), 0.021)
    colour = _belt(colour, band, bottom, place)
    strength = 0.03 + 0.09 * bump(place.y, 0.49, 0.08)
    strength = strength + 0.09 * bump(place.y, 0.18, 0.08)
    strength = strength * (0.4 if bottom.kind == "leggings" else 1.0)
    inner = 1 - 0.18 * bump(place.x, 0.0, 0.035) * smoothstep(0.86, 0.74, place.y)
    return piece.image(colour * (_folds(across, place.y, noise, strength) * inner)[:, None])


def _belt(colour: np.ndarray, band: np.ndarray, bottom: Bottom, place: Place) -> np.ndarray:
    """Paint a belt with its buckle, or the seam of a waistband.

    Args:
        colour: [k, 3] in [0, 1].
        band: [k] mask of the belt, 0 to 1.
        bottom: the garment.
        place: places of the k texels.

    Returns:
        Colours [k, 3].
    """
    if bottom.belt is None:
        return darken(colour, _line(place.y - bottom.waist + 0.038, 0.003), 0.3)
    colour = mix(colour, band, bottom.belt)
    buckle = np.maximum(np.abs(place.x) - 0.022, np.abs(place.y - bottom.waist + 0.018) - 0.016)
    return mix(colour, _line(buckle, 0.006) * (place.z > 0.08), np.array([0.75, 0.72, 0.62]))


def _denim(fabric: Fabric, across: np.ndarray, place: Place, noise: Noise) -> np.ndarray:
    """Paint twill, faded at thigh and knee.

    Args:
        fabric: provides the first colour and the noise.
        across: [k] metres around the leg.
        place: places of the k texels.
        noise: noise of the faded parts.

    Returns:
        Colours [k, 3].
    """
    twill = np.sin(2 * np.pi * (across + 0.6 * place.y) / 0.006)
    worn = bump(place.y, 0.62, 0.20) * smoothstep(1.5, 0.3, np.abs(place.leg_angle))
    worn = worn * np.clip(0.75 + 0.35 * noise(across / 0.5, place.y / 0.9), 0, 1.4)
    base = fabric.colours[0]
    colour = mix(base, 0.42 * worn, np.minimum(base * 1.5 + 0.16, 0.92))
    shade = (
        1
        + 0.06 * twill
        + 0.06 * fabric.fine(across / 0.12, place.y / 0.30)
        + 0.05 * fabric.noise(across, place.y)
    )
    return colour * shade[:, None]


def _pockets(colour: np.ndarray, place: Place, bottom: Bottom) -> np.ndarray:
    """Paint the seams of pockets, fly and crotch, with visible thread on jeans.

    Args:
        colour: [k, 3] in [0, 1].
        place: places of the k texels.
        bottom: the garment.

    Returns:
        Colours [k, 3].
    """
    thread = np.array([0.72, 0.50, 0.25]) if bottom.kind == "jeans" else None

    def stitch(colour: np.ndarray, mask: np.ndarray) -> np.ndarray:
        """Darken colours [k, 3] where a mask [k] is 1, and paint the thread there."""
        colour = darken(colour, mask, 0.35)
        return colour if thread is None else mix(colour, 0.5 * mask, thread)

    x = np.abs(place.x)
    low = place.y - (bottom.waist - 0.03)
    front = place.z > 0.09
    back = place.z < 0.06
    arc = np.hypot(x - 0.175, low - 0.01) - 0.085
    colour = stitch(colour, _line(arc, 0.003) * front * (low < 0) * (low > -0.11))
    fly = np.where(low > -0.09, place.x + 0.022, np.hypot(place.x, low + 0.09) - 0.022)
    colour = stitch(colour, _line(fly, 0.0025) * front * (low < 0) * (low > -0.115) * (place.x < 0))
    colour = stitch(colour, _line(place.x, 0.0025) * (place.y > 0.77))
    point = 0.012 - 0.25 * np.abs(x - 0.085)
    patch = np.maximum(np.abs(x - 0.085) - 0.058, np.maximum(low + 0.06, -(low + 0.19) - point))
    return stitch(colour, _line(patch, 0.003) * back)


def _skirt_texture(bottom: Bottom, noise: Noise) -> np.ndarray:
    """Paint a skirt; arguments and result as for :func:`bottom_texture`."""
    piece = chart("skirt")
    place = piece.texel_place
    across = place.trunk_angle * 0.17
    colour = paint(bottom.fabric, across, place.y)
    colour = darken(colour, _line(place.y - bottom.hem - 0.018, 0.0025), 0.25)
    colour = _belt(colour, _line(np.clip(place.y - bottom.waist + 0.018, -1, 1), 0.021), bottom, place)
    shade = 1 - 0.06 * np.clip(0.6 - noise(across / 0.5, place.y / 2.5), 0, 1.6)
    return piece.image(colour * shade[:, None])


def shoe_texture(shoes: Shoes) -> np.ndarray:
    """Paint upper, toe cap, laces and sole of shoes.

    Args:
        shoes: kind and colours.

    Returns:
        Texture [h, w, 3] uint8 of the chart ``shoes``.
    """
    piece = chart("shoes")
    place = piece.texel_place
    colour = np.tile(shoes.upper, (len(place.y), 1))
    x = np.abs(place.x) - 0.197
    instep = (np.abs(x) < 0.020) & (place.z > 0.075) & (place.z < 0.175) & (place.y > 0.035)
    if shoes.kind == "sneakers":
        colour = mix(colour, smoothstep(0.215, 0.217, place.z) * 0.8, shoes.sole)
        swoosh = (
            _line(place.y - 0.045 - 0.5 * (place.z - 0.10), 0.008) * (np.abs(x) > 0.022) * (place.z < 0.16)
        )
        colour = mix(colour, 0.9 * swoosh * (place.z > 0.04), shoes.laces)
    row = place.z / 0.016
    laces = (np.abs(row - np.rint(row)) < 0.24) & instep
    if shoes.kind != "leather" or shoes.upper.mean() > 0.12:
        colour = darken(colour, instep.astype(float), 0.25)
        colour = mix(colour, laces.astype(float), shoes.laces)
    colour = darken(colour, _line(place.y - 0.018, 0.003), 0.35)
    return piece.image(mix(colour, 1 - smoothstep(0.014, 0.017, place.y), shoes.sole))
