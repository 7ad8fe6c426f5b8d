"""Parameters of a person's clothes, from which `garments` makes shapes and `garment_textures` colours.

Heights are those of the average body at rest (metres above the soles; crotch 0.77, waist about 1.0,
neck 1.43); sleeves are measured from the shoulder joint along the arm (elbow 0.25, wrist 0.50).
"""

from dataclasses import dataclass

import numpy as np

from ghgs_people.figures.fabric import Fabric, random_colour, sample_fabric

SMOOTH_KNITS = ("plain", "melange", "stripes", "block", "dots", "blobs", "gradient", "camouflage", "zigzag")
WOOLS = ("knit", "melange", "stripes", "zigzag", "argyle", "block", "gradient", "plain")
WOVEN = ("plain", "checks", "gingham", "pinstripes", "dots", "stripes", "blobs")
DENIMS = (
    (0.17, 0.24, 0.38), (0.30, 0.42, 0.58), (0.12, 0.14, 0.20), (0.52, 0.62, 0.72), (0.30, 0.30, 0.32),
)  # fmt: skip
SKIRTINGS = ("plain", "dots", "blobs", "checks", "zigzag", "gradient", "gingham", "stripes")


@dataclass(frozen=True)
class Top:
    """A garment for the upper body."""

    kind: str  # tee, sweater, shirt, tank or jacket
    # length of the sleeves in metres; of a tank, distance of the armholes from the middle
    sleeve: float
    hem: float  # height in metres
    neck: str  # neckline: crew, scoop, vee, collar or straps
    ease: float  # air between cloth and body in metres
    hang: float  # 0 to 1, how straight it falls from the chest
    tucked: bool  # into trousers or skirt
    fabric: Fabric
    emblem: str | None = None  # printed on the front, the back or both; None: nowhere
    opening: float = 0.0  # half width in metres of the gap of an open jacket


@dataclass(frozen=True)
class Bottom:
    """Trousers or a skirt."""

    kind: str  # jeans, chinos, joggers, leggings, shorts or skirt
    waist: float  # height in metres
    hem: float  # height in metres
    # radius of a leg at the hem in metres; of shorts, how much wider than the thigh;
    # of a skirt, its flare
    width: float
    fabric: Fabric
    belt: np.ndarray | None = None  # colour [3]; None: no belt


@dataclass(frozen=True)
class Shoes:
    """Shoes and socks."""

    kind: str  # sneakers, leather or boots
    top: float  # height in metres
    # upper, sole, laces: colours [3]
    upper: np.ndarray
    sole: np.ndarray
    laces: np.ndarray
    socks: tuple[float, np.ndarray] | None  # height in metres and colour [3]; None: no socks


@dataclass(frozen=True)
class Outfit:
    """All clothes, from the skin outwards."""

    top: Top
    jacket: Top | None
    bottom: Bottom
    shoes: Shoes
    beanie: Fabric | None


def sample_outfit(rng: np.random.Generator, female: bool) -> Outfit:
    """Sample an outfit.

    Args:
        rng: samples everything.
        female: allows skirts and cropped tops.
    """
    skirt = female and rng.random() < 0.36
    dress = skirt and rng.random() < 0.4
    top = _sample_top(rng, female, tucked=skirt or rng.random() < 0.3)
    bottom = _sample_skirt(rng) if skirt else _sample_trousers(rng, female)
    if dress:
        bottom = Bottom("skirt", 0.97, bottom.hem, bottom.width, top.fabric, bottom.belt)
    jacket = None
    if not dress and top.kind in ("tee", "tank", "shirt") and rng.random() < 0.3:
        fabric = sample_fabric(rng, ("plain", "melange", "knit", "checks", "pinstripes"))
        hem = rng.uniform(0.82, 0.95)
        opening = rng.uniform(0.035, 0.09)
        jacket = Top("jacket", 0.478, hem, "vee", 0.024, 0.5, False, fabric, None, opening)
    shoes = _sample_shoes(rng, bottom)
    beanie = sample_fabric(rng, ("knit", "stripes", "melange")) if rng.random() < 0.09 else None
    return Outfit(top, jacket, bottom, shoes, beanie)


def _sample_top(rng: np.random.Generator, female: bool, tucked: bool) -> Top:
    """Sample a top.

    Args:
        rng: samples everything.
        female: allows a cropped top.
        tucked: into trousers or skirt.
    """
    kind = str(rng.choice(("tee", "sweater", "shirt", "tank"), p=(0.40, 0.27, 0.22, 0.11)))
    hem = rng.uniform(0.84, 0.93)
    if kind == "tee":
        neck = str(rng.choice(("crew", "vee", "scoop"), p=(0.6, 0.2, 0.2)))
        fabric = sample_fabric(rng, SMOOTH_KNITS)
        sleeve = rng.uniform(0.10, 0.20)
        ease = rng.uniform(0.007, 0.016)
        hang = rng.uniform(0.2, 0.9)
    elif kind == "sweater":
        neck = str(rng.choice(("crew", "vee"), p=(0.8, 0.2)))
        fabric = sample_fabric(rng, WOOLS)
        sleeve = rng.uniform(0.45, 0.475)
        ease = rng.uniform(0.012, 0.022)
        hang = rng.uniform(0.4, 1.0)
    elif kind == "shirt":
        neck = "collar"
        fabric = sample_fabric(rng, WOVEN)
        sleeve = 0.472 if rng.random() < 0.6 else rng.uniform(0.17, 0.30)
        ease = rng.uniform(0.009, 0.017)
        hang = rng.uniform(0.4, 0.9)
    else:
        neck = "straps"
        fabric = sample_fabric(rng, SMOOTH_KNITS)
        sleeve = rng.uniform(0.122, 0.135) if female else rng.uniform(0.140, 0.155)
        ease = rng.uniform(0.005, 0.010)
        hang = rng.uniform(0.0, 0.6)
    emblem = None
    if (
        kind in ("tee", "sweater")
        and fabric.pattern in ("plain", "melange", "gradient")
        and rng.random() < 0.75
    ):
        emblem = str(rng.choice(("front", "back", "both"), p=(0.6, 0.1, 0.3)))
    if female and not tucked and rng.random() < 0.2:
        hem = rng.uniform(0.98, 1.02)  # cropped
    return Top(kind, sleeve, hem, neck, ease, hang if not tucked else 0.35 * hang, tucked, fabric, emblem)


def _sample_trousers(rng: np.random.Generator, female: bool) -> Bottom:
    shares = (0.36, 0.20, 0.12, 0.14, 0.18) if female else (0.40, 0.26, 0.12, 0.0, 0.22)
    kind = str(rng.choice(("jeans", "chinos", "joggers", "leggings", "shorts"), p=shares))
    patterns = ("plain", "melange")
    if kind != "jeans" and rng.random() < 0.4:
        patterns = (
            ("pinstripes", "checks") if kind == "chinos" else ("camouflage", "dots", "checks", "melange")
        )
    fabric = sample_fabric(rng, patterns)
    if kind == "jeans":
        shade = np.array(DENIMS[rng.integers(len(DENIMS))])
        fabric.colours[0] = np.clip(shade + rng.normal(0, 0.02, 3), 0.05, 0.9)
    elif rng.random() < 0.7:
        fabric.colours[0] = random_colour(rng, 0.9)
    hem = rng.uniform(0.40, 0.58) if kind == "shorts" else rng.uniform(0.045, 0.10)
    width = {"leggings": 0.0, "joggers": 0.058, "shorts": rng.uniform(0.0, 0.022)}.get(
        kind, rng.uniform(0.058, 0.098)
    )
    belt = random_colour(rng, 0.9) * 0.6 if kind in ("jeans", "chinos") and rng.random() < 0.6 else None
    return Bottom(kind, rng.uniform(0.97, 1.01), hem, width, fabric, belt)


def _sample_skirt(rng: np.random.Generator) -> Bottom:
    belt = random_colour(rng, 0.7) if rng.random() < 0.35 else None
    return Bottom(
        "skirt", 0.985, rng.uniform(0.25, 0.62), rng.uniform(0.0, 0.55), sample_fabric(rng, SKIRTINGS), belt
    )


def _sample_shoes(rng: np.random.Generator, bottom: Bottom) -> Shoes:
    kind = str(rng.choice(("sneakers", "leather", "boots"), p=(0.62, 0.23, 0.15)))
    upper = random_colour(rng, 0.5)
    if kind != "sneakers":
        upper = random_colour(rng, 1.0) * 0.55
    sole = np.array([0.92, 0.92, 0.89]) if kind == "sneakers" and rng.random() < 0.75 else 0.4 * upper
    top = {"sneakers": rng.uniform(0.070, 0.085), "leather": 0.066, "boots": 0.122}[kind]
    socks = None
    if kind != "boots" and rng.random() < 0.7:
        socks = (rng.uniform(0.10, 0.16) if bottom.hem > 0.2 else 0.2, random_colour(rng, 0.7))
    return Shoes(kind, top, upper, sole, random_colour(rng, 0.7), socks)
