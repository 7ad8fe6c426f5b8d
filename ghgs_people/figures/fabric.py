"""Colours of cloth: weaves, patterns and prints as functions of position along and around the body, in
metres."""

import colorsys
from dataclasses import dataclass

import numpy as np

from ghgs_people.figures.blending import mix, smoothstep
from ghgs_people.figures.noise import Noise

PATTERNS = {  # relative frequencies
    "plain": 5.0, "melange": 2.0, "knit": 1.5, "stripes": 2.5, "pinstripes": 1.0, "checks": 2.0,
    "gingham": 1.0, "dots": 1.2, "blobs": 1.5, "camouflage": 0.7, "block": 1.4, "gradient": 0.6,
    "zigzag": 0.7, "argyle": 0.7,
}  # fmt: skip
NEUTRALS = (
    (0.09, 0.09, 0.10), (0.20, 0.21, 0.23), (0.45, 0.46, 0.48), (0.72, 0.72, 0.70), (0.93, 0.93, 0.91),
    (0.90, 0.86, 0.76), (0.11, 0.15, 0.27), (0.33, 0.23, 0.16), (0.33, 0.35, 0.22), (0.64, 0.54, 0.40),
)  # fmt: skip


def random_colour(rng: np.random.Generator, neutral: float = 0.4) -> np.ndarray:
    """Sample a colour of clothes.

    Args:
        rng: samples it.
        neutral: probability of grey, navy or brown.

    Returns:
        [3] in [0, 1].
    """
    if rng.random() < neutral:
        return np.clip(np.array(NEUTRALS[rng.integers(len(NEUTRALS))]) + rng.normal(0, 0.025, 3), 0.04, 0.96)
    saturation = rng.uniform(0.35, 0.88)
    value = rng.uniform(0.35, 0.92)
    return np.array(colorsys.hsv_to_rgb(rng.random(), saturation, value))


@dataclass(frozen=True)
class Fabric:
    """A pattern with up to three colours."""

    pattern: str
    colours: np.ndarray  # [3, 3] in [0, 1]
    scale: float  # period of the pattern in metres
    tilt: float  # rotation of the pattern in radians
    grain: float  # strength of the fine noise
    noise: Noise
    fine: Noise


def sample_fabric(rng: np.random.Generator, patterns: tuple[str, ...] | None = None) -> Fabric:
    """Sample a fabric.

    Args:
        rng: samples everything.
        patterns: allowed names of `PATTERNS`; None: all.
    """
    names = tuple(patterns or PATTERNS)
    weights = np.array([PATTERNS[name] for name in names])
    pattern = str(rng.choice(names, p=weights / weights.sum()))
    colours = np.stack([random_colour(rng, 0.35), random_colour(rng, 0.45), random_colour(rng, 0.3)])
    if np.abs(colours[0] - colours[1]).sum() < 0.5:  # make the pattern visible
        colours[1] = np.where(colours[0].mean() > 0.5, colours[1] * 0.35, 0.65 + 0.35 * colours[1])
    scale = rng.uniform(0.03, 0.085)
    tilt = rng.uniform(-0.5, 0.5) if pattern in ("blobs", "camouflage") else 0.0
    return Fabric(
        pattern, colours, scale, tilt, rng.uniform(0.02, 0.05), Noise(rng, 1.6, 3.0), Noise(rng, 0.45, 12.0)
    )


def _edge(x: np.ndarray, threshold: float, width: float) -> np.ndarray:
    """Soft threshold.

    Args:
        x: any shape.
        threshold: value of ``x`` at which the result is 0.5.
        width: distance from the threshold at which it is 0 or 1.

    Returns:
        1 where ``x`` is above the threshold, 0 below.
    """
    return smoothstep(threshold - width, threshold + width, x)


def _wave(x: np.ndarray) -> np.ndarray:
    """Triangle wave of period 1 between 0 (at whole numbers) and 1 (halfway)."""
    return 2 * np.abs(x - np.rint(x))


def paint(fabric: Fabric, across: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Compute the colours of points on cloth.

    Args:
        fabric: pattern and colours.
        across: [k] metres around the body.
        along: [k] metres up it.

    Returns:
        Colours [k, 3], about 0 to 1.
    """
    one, two, three = fabric.colours
    u = (np.cos(fabric.tilt) * across + np.sin(fabric.tilt) * along) / fabric.scale
    v = (np.cos(fabric.tilt) * along - np.sin(fabric.tilt) * across) / fabric.scale
    soft = 0.0012 / fabric.scale
    coarse = fabric.noise(across / 0.9, along / 0.9)
    fine = fabric.fine(across / 0.16, along / 0.16)
    second, third = _pattern(fabric.pattern, u, v, along, soft, coarse, fabric)
    colour = mix(mix(one, second, two), third, three)
    shade = 1 + fabric.grain * fine + 0.025 * coarse
    if fabric.pattern == "knit":
        ribs = np.sin(2 * np.pi * across / 0.016) * (0.75 + 0.25 * np.sin(2 * np.pi * along / 0.013))
        shade = shade + 0.10 * ribs
    if fabric.pattern == "melange":
        shade = shade + 0.055 * fine + 0.06 * fabric.fine(across / 0.5, along / 0.06)
    return colour * shade[:, None]


def _pattern(
    name: str,
    u: np.ndarray,
    v: np.ndarray,
    along: np.ndarray,
    soft: float,
    coarse: np.ndarray,
    fabric: Fabric,
) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate a pattern.

    Args:
        name: one of `PATTERNS`.
        u: [k] coordinate across the pattern, periods.
        v: [k] coordinate along the pattern, periods.
        along: [k] metres up the body.
        soft: width of edges, periods.
        coarse: [k] smooth noise with zero mean and unit variance.
        fabric: provides the noise.

    Returns:
        Weights [k] of the second and of the third colour, 0 to 1.
    """
    none = np.zeros_like(u)
    if name == "stripes":
        return _edge(_wave(v), 0.5, 2 * soft), _edge(_wave(v / 4), 0.94, soft)
    if name == "pinstripes":
        return _edge(1 - _wave(1.5 * u), 0.86, 0.06), none
    if name == "checks":
        broad = 0.45 * _edge(_wave(u), 0.55, soft) + 0.45 * _edge(_wave(v), 0.55, soft)
        thin = np.maximum(_edge(1 - _wave(u + 0.25), 0.93, soft), _edge(1 - _wave(v + 0.25), 0.93, soft))
        return broad, 0.75 * thin
    if name == "gingham":
        return 0.5 * _edge(_wave(2 * u), 0.5, 2 * soft) + 0.5 * _edge(_wave(2 * v), 0.5, 2 * soft), none
    if name == "dots":
        row = np.floor(v)
        radius = np.hypot(u + 0.5 * row - np.rint(u + 0.5 * row), v - row - 0.5)
        return 1 - _edge(radius, 0.27, 1.5 * soft), none
    if name == "blobs":
        field = fabric.noise(u / 9, v / 9)
        other = fabric.noise(u / 9 + 0.37, v / 9 + 0.61)
        return _edge(field, 0.7, 0.12), _edge(other, 0.95, 0.12)
    if name == "camouflage":
        field = fabric.noise(u / 14, v / 18)
        other = fabric.noise(u / 14 + 0.43, v / 18 + 0.29)
        return _edge(field, 0.25, 0.05), _edge(other, 0.6, 0.05)
    if name == "block":
        return _edge(along, 1.19, 0.002), _edge(np.abs(along - 1.19), -1, 1) * (np.abs(along - 1.19) < 0.012)
    if name == "gradient":
        return smoothstep(0.8, 1.4, along + 0.02 * coarse), none
    if name == "zigzag":
        return _edge(_wave(v + 0.5 * _wave(u)), 0.5, 2 * soft), none
    if name == "argyle":
        diamond = _wave(u / 2) + _wave(v / 3)
        lines = np.minimum(np.abs(_wave(u / 2 + v / 3) - 0.5), np.abs(_wave(u / 2 - v / 3) - 0.5))
        return _edge(diamond, 1.0, 2 * soft), 0.8 * (1 - _edge(lines, 0.035, 0.012))
    return none, none


def print_emblem(
    colour: np.ndarray, x: np.ndarray, y: np.ndarray, centre: tuple[float, float], rng: np.random.Generator
) -> np.ndarray:
    """Print a random emblem on front or back.

    Args:
        colour: [k, 3] in [0, 1] of the cloth.
        x: [k] metres to the right, as seen by a viewer.
        y: [k] metres up.
        centre: (x, y) of the emblem's centre, metres.
        rng: samples kind, colour and size.

    Returns:
        Colours [k, 3].
    """
    kind = str(rng.choice(("disc", "letters", "bars", "star", "rings", "number")))
    ink = random_colour(rng, 0.3)
    size = rng.uniform(0.05, 0.10)
    if np.abs(ink - colour.mean(0)).sum() < 0.6:
        ink = np.where(colour.mean() > 0.5, 0.2 * ink, 0.7 + 0.3 * ink)
    u = (x - centre[0]) / size
    v = (y - centre[1]) / size
    radius = np.hypot(u, v)
    angle = np.arctan2(v, u)
    soft = 0.0012 / size
    if kind == "disc":
        cut = int(rng.integers(2, 6))
        mask = (1 - _edge(radius, 1, soft)) * _edge(np.abs(np.sin(cut * (v + 0.3 * u))), 0.35, 0.1)
    elif kind == "bars":
        mask = (np.abs(u) < 1.25) * (np.abs(v) < 0.8) * _edge(_wave(v * rng.uniform(1.5, 3)), 0.5, 3 * soft)
    elif kind == "star":
        points = int(rng.integers(5, 9))
        mask = 1 - _edge(radius * (1 + 0.42 * np.cos(points * angle)), 0.62, soft)
    elif kind == "rings":
        mask = (1 - _edge(radius, 1, soft)) * _edge(_wave(radius * rng.uniform(1.6, 3.2)), 0.45, 4 * soft)
    else:
        mask = _glyphs(u, v, 2 if kind == "number" else int(rng.integers(3, 6)), soft, rng)
    return mix(colour, 0.94 * mask, ink)


def _glyphs(u: np.ndarray, v: np.ndarray, count: int, soft: float, rng: np.random.Generator) -> np.ndarray:
    """Mask of letter-like signs in a row: strokes between the nodes of a small grid.

    Args:
        u: [k] coordinate to the right, in half sizes of the emblem.
        v: [k] coordinate upwards, in half sizes of the emblem.
        count: number of signs.
        soft: half width of the strokes' edges, in half sizes of the emblem.
        rng: samples the strokes.

    Returns:
        Mask [k], 0 to 1.
    """
    mask = np.zeros_like(u)
    pitch = 2.6 / count
    height = min(0.75, 2.2 / count)
    nodes = np.array([(-0.36, -1), (0.36, -1), (-0.36, 0), (0.36, 0), (-0.36, 1), (0.36, 1)])
    for index in range(count):
        centre = (index - (count - 1) / 2) * pitch
        order = rng.permutation(6)[: rng.integers(4, 6)]
        for a, b in zip(nodes[order[:-1]], nodes[order[1:]], strict=True):
            ax = centre + a[0] * pitch
            ay = a[1] * height
            bx = centre + b[0] * pitch
            by = b[1] * height
            dx = bx - ax
            dy = by - ay
            t = np.clip(((u - ax) * dx + (v - ay) * dy) / (dx * dx + dy * dy), 0, 1)
            distance = np.hypot(u - ax - t * dx, v - ay - t * dy)
            mask = np.maximum(mask, 1 - _edge(distance, 0.13, soft))
    return mask
