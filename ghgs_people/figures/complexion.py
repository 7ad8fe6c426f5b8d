"""Colours of a person's skin, hair and eyes, and textures of head, skin and eyes."""

from dataclasses import dataclass

import numpy as np

from ghgs_people.figures.blending import bump, darken, mix, smoothstep
from ghgs_people.figures.body import load_body
from ghgs_people.figures.charts import Chart, chart
from ghgs_people.figures.noise import Noise
from ghgs_people.figures.outfit import Shoes
from ghgs_people.figures.place import EYE, face_frame, hairline

SKINS = (
    (0.92, 0.75, 0.65), (0.88, 0.69, 0.57), (0.83, 0.64, 0.50), (0.72, 0.52, 0.38), (0.56, 0.38, 0.27),
    (0.43, 0.28, 0.20), (0.33, 0.21, 0.155),
)  # fmt: skip
IRISES = ((0.28, 0.17, 0.08), (0.20, 0.12, 0.06), (0.35, 0.45, 0.55), (0.33, 0.40, 0.25), (0.45, 0.33, 0.15))


@dataclass(frozen=True)
class Complexion:
    """The colours of a person."""

    # skin, lips, hair, iris: [3] in [0, 1]
    skin: np.ndarray
    lips: np.ndarray
    hair: np.ndarray
    iris: np.ndarray
    # beard, brows, makeup, freckles: strengths, about 0 to 1
    beard: float
    beard_style: str  # none, stubble, full, goatee or moustache
    brows: float
    makeup: float
    freckles: float
    noise: Noise
    fine: Noise


def sample_complexion(rng: np.random.Generator, female: bool, age: float) -> Complexion:
    """Sample the colours of a person: dark skin comes with dark hair and eyes, and hair turns grey with age.

    Args:
        rng: samples everything.
        female: allows makeup; otherwise a beard.
        age: from 0.67 (young) to 1 (old).
    """
    tone = rng.uniform(0, len(SKINS) - 1)
    skin = np.array([np.interp(tone, range(len(SKINS)), channel) for channel in np.transpose(SKINS)])
    skin = np.clip(skin * (1 + rng.normal(0, 0.025, 3)), 0.08, 0.97)
    dark = tone > 2.6
    hairs = (
        (0.07, 0.055, 0.05),
        (0.16, 0.10, 0.07),
        (0.28, 0.18, 0.11),
        (0.45, 0.30, 0.17),
        (0.72, 0.56, 0.34),
        (0.50, 0.21, 0.10),
    )
    shares = (0.72, 0.22, 0.06, 0, 0, 0) if dark else (0.2, 0.25, 0.22, 0.13, 0.13, 0.07)
    hair = np.array(hairs[rng.choice(6, p=shares)]) * rng.uniform(0.85, 1.15)
    grey = rng.random() < (age - 0.68) * 1.8
    if grey:
        hair = hair + (np.array([0.72, 0.71, 0.70]) - hair) * rng.uniform(0.4, 0.95)
    elif rng.random() < 0.06:
        hair = np.array([rng.uniform(0.2, 0.8), rng.uniform(0.1, 0.5), rng.uniform(0.2, 0.8)])
    iris = np.array(IRISES[rng.integers(2) if dark else rng.integers(len(IRISES))])
    makeup = float(female and rng.random() < 0.6) * rng.uniform(0.3, 1.0)
    rose = skin * np.array([0.88, 0.62, 0.60])
    lipstick = np.array([rng.uniform(0.5, 0.8), rng.uniform(0.08, 0.25), rng.uniform(0.12, 0.32)])
    beard = 0.0
    style = "none"
    if not female and rng.random() < 0.55:
        beard = rng.uniform(0.25, 0.95)
        style = str(rng.choice(("stubble", "full", "goatee", "moustache")))
    return Complexion(
        skin=skin,
        lips=rose + (lipstick - rose) * 0.75 * makeup,
        hair=hair,
        iris=iris,
        beard=beard,
        beard_style=style,
        brows=rng.uniform(0.6, 1.3) * (0.8 if female else 1.1),
        makeup=makeup,
        freckles=float(rng.random() < 0.2) * rng.uniform(0.3, 1.0),
        noise=Noise(rng, 1.4, 2.0),
        fine=Noise(rng, 0.3, 20.0),
    )


def _blob(
    point: np.ndarray, centre: tuple[float, float, float], size: tuple[float, float, float]
) -> np.ndarray:
    """Mask of a soft spot on both sides of the face.

    Args:
        point: [k, 3], metres, in the frame of :func:`.place.face_frame`.
        centre: centre of the left spot, metres.
        size: distance along x, y and z at which the mask is 1 / e, metres.

    Returns:
        [k], 1 at the centre, 0 far away.
    """
    offset = (np.stack([np.abs(point[:, 0]), point[:, 1], point[:, 2]], 1) - centre) / size
    return np.exp(-(offset**2).sum(1))


def _grain(look: Complexion, point: np.ndarray) -> np.ndarray:
    """Factor [k] on the colours of skin points [k, 3], for fine and coarse spots."""
    u = point[:, 0] + 0.5 * point[:, 2]
    v = point[:, 1] + 0.3 * point[:, 2]
    return 1 + 0.030 * look.noise(u / 0.45, v / 0.45) + 0.018 * look.fine(u / 0.12, v / 0.12)


def head_texture(look: Complexion, scalp: float) -> np.ndarray:
    """Paint the head.

    Args:
        look: colours of the person.
        scalp: how strongly hair covers the scalp, 0 to 1.

    Returns:
        Texture [h, w, 3] uint8.
    """
    piece = chart("head")
    point = face_frame(piece.texel_place.point)
    above = hairline(piece.texel_place.point)
    masks = _masks(piece)
    lips, lids, ears = masks.T
    colour = np.tile(look.skin, (len(point), 1))
    flush = 0.5 * _blob(point, (0.040, 1.520, 0.200), (0.020, 0.018, 0.03)) + 0.35 * _blob(
        point, (0.0, 1.525, 0.232), (0.014, 0.014, 0.02)
    )
    flush = flush * (0.5 + 0.6 * look.makeup) + 0.35 * ears
    colour = colour * (1 - flush[:, None] * np.array([0.02, 0.16, 0.14]))
    hollow = _blob(point, (0.030, 1.568, 0.205), (0.022, 0.014, 0.03))
    colour = darken(colour, hollow, 0.16)
    u = point[:, 0]
    v = point[:, 1]
    if look.freckles:
        spots = smoothstep(1.4, 2.2, look.fine(u / 0.09, v / 0.09)) * _blob(
            point, (0.03, 1.53, 0.21), (0.035, 0.03, 0.04)
        )
        colour = darken(colour, spots, 0.35 * look.freckles)
    colour = mix(colour, 0.85 * lips, look.lips)
    seam = bump(v, 1.496, 0.0016) * (np.abs(u) < 0.026) * (point[:, 2] > 0.19)
    colour = darken(colour, seam, 0.5)
    colour = colour * _grain(look, point)[:, None]
    colour = _eyes_and_brows(colour, look, point, lids)
    colour = _beard(colour, look, point, lips)
    strands = 0.8 + 0.2 * look.fine(point[:, 0] / 0.10, point[:, 2] / 0.10)
    shadow = smoothstep(-0.004, 0.012, above + 0.003 * look.fine(u / 0.06, v / 0.06)) * (1 - ears) * scalp
    shadow = shadow * (1 - smoothstep(1.48, 1.46, point[:, 1]))
    colour = mix(colour, 0.92 * shadow, look.hair * 0.85 * strands[:, None])
    nostril = _blob(point, (0.0085, 1.5155, 0.2235), (0.0035, 0.0028, 0.006))
    return piece.image(darken(colour, nostril, 0.6))


def _masks(piece: Chart) -> np.ndarray:
    """Masks [k, 3] of lips, eyelids and ears, 0 to 1, for the head's texels."""
    return load_body().head_masks.reshape(-1, 4)[piece.texels, :3] / 255.0


def _eyes_and_brows(colour: np.ndarray, look: Complexion, point: np.ndarray, lids: np.ndarray) -> np.ndarray:
    """Paint eyelids, lashes and brows.

    Args:
        colour: [k, 3] in [0, 1] of the head's texels.
        look: colours of the person.
        point: [k, 3], metres, in the frame of :func:`.place.face_frame`.
        lids: [k] mask of the eyelids, 0 to 1.

    Returns:
        Colours [k, 3].
    """
    x = np.abs(point[:, 0])
    y = point[:, 1]
    z = point[:, 2]
    dark = look.hair * 0.45
    distance = np.linalg.norm(np.stack([x, y, z], 1) - EYE, axis=1)
    lash = (1 - smoothstep(0.0150, 0.0168, distance)) * (z > 0.19) * np.where(y > EYE[1] - 0.002, 1.0, 0.45)
    shadow = np.array([0.45, 0.30, 0.38])
    colour = mix(colour, 0.45 * look.makeup * lids, shadow * look.skin)
    colour = mix(colour, (0.55 + 0.35 * look.makeup) * lash, dark)
    t = np.clip((x - 0.0125) / 0.040, 0, 1)
    arch = EYE[1] + 0.0195 + 0.0065 * np.sin(np.pi * (0.12 + 0.72 * t)) - 0.002 * t
    half = 0.0044 * look.brows * (1 - 0.65 * t**1.5)
    strokes = 0.75 + 0.35 * look.fine((x + 0.8 * y) / 0.020, (y - 0.5 * x) / 0.06)
    brow = (
        (1 - smoothstep(0.55, 1.1, np.abs(y - arch) / half))
        * smoothstep(0.010, 0.014, x)
        * smoothstep(0.056, 0.050, x)
    )
    return mix(colour, np.clip(0.85 * brow * strokes * (z > 0.15), 0, 1), dark)


def _beard(colour: np.ndarray, look: Complexion, point: np.ndarray, lips: np.ndarray) -> np.ndarray:
    """Paint a beard of the style and strength of ``look``.

    Args:
        colour: [k, 3] in [0, 1] of the head's texels.
        look: colours of the person.
        point: [k, 3], metres, in the frame of :func:`.place.face_frame`.
        lips: [k] mask of the lips, 0 to 1.

    Returns:
        Colours [k, 3].
    """
    if look.beard_style == "none":
        return colour
    x = np.abs(point[:, 0])
    y = point[:, 1]
    z = point[:, 2]
    jaw = (
        smoothstep(1.520, 1.500, y + 0.5 * np.clip(0.19 - z, -0.05, 0.06))
        * smoothstep(1.425, 1.445, y)
        * smoothstep(0.10, 0.13, z)
    )
    moustache = (
        (1 - smoothstep(0.8, 1.1, np.abs(y - 1.508) / 0.0065))
        * (x < 0.030 - 0.6 * np.abs(y - 1.508))
        * (z > 0.19)
    )
    chin = jaw * (1 - smoothstep(0.8, 1.15, np.hypot(x / 0.032, (y - 1.475) / 0.042)))
    area = {"stubble": jaw, "full": jaw, "goatee": chin, "moustache": 0 * jaw}[look.beard_style]
    area = np.maximum(area, moustache) * (1 - lips)
    density = (0.30 + 0.25 * look.beard if look.beard_style == "stubble" else 0.55 + 0.4 * look.beard) * area
    hairs = np.clip(0.75 + 0.35 * look.fine(point[:, 0] / 0.05, y / 0.08), 0, 1.2)
    return mix(colour, np.clip(density * hairs, 0, 1), look.hair * 0.8)


def skin_texture(look: Complexion, shoes: Shoes) -> np.ndarray:
    """Paint neck, arms, hands and legs, with socks.

    Args:
        look: colours of the person.
        shoes: the shoes, with their socks.

    Returns:
        Texture [h, w, 3] uint8.
    """
    piece = chart("skin")
    place = piece.texel_place
    colour = look.skin * _grain(look, place.point)[:, None]
    knuckles = smoothstep(0.53, 0.60, place.sleeve) * (place.arm > 0.5)
    colour = colour * (1 - knuckles[:, None] * np.array([0.0, 0.05, 0.05]))
    if shoes.socks is not None:
        height, sock = shoes.socks
        ribs = 1 + 0.06 * np.sin(place.y * 2 * np.pi / 0.006)
        mask = 1 - smoothstep(height - 0.002, height, place.y)
        colour = mix(colour, mask, sock * ribs[:, None])
    return piece.image(colour)


def eye_texture(look: Complexion) -> np.ndarray:
    """Paint white, iris and pupil of both eyeballs.

    Args:
        look: colours of the person.

    Returns:
        Texture [h, w, 3] uint8.
    """
    piece = chart("eyes")
    point = face_frame(piece.texel_place.point)
    folded = np.stack([np.abs(point[:, 0]), point[:, 1], point[:, 2]], 1) - EYE
    angle = np.degrees(np.arctan2(np.hypot(folded[:, 0], folded[:, 1]), folded[:, 2]))
    colour = np.tile([0.90, 0.88, 0.86], (len(point), 1))
    iris = 1 - smoothstep(26.0, 30.0, angle)
    ring = bump(angle, 27.0, 3.0)
    colour = mix(colour, iris, look.iris)
    colour = darken(colour, ring, 0.5)
    colour = colour * smoothstep(9.0, 12.0, angle)[:, None]
    glint = 1 - smoothstep(
        3.0, 5.0, np.degrees(np.hypot(folded[:, 0] - 0.002, folded[:, 1] - 0.003) / 0.0145)
    )
    return piece.image(mix(colour, glint * (folded[:, 2] > 0), 0.95))
