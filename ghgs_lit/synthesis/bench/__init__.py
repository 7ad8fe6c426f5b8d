"""Frozen people of ``data=synthetic``: nobody trains on them, and everybody measures the same ones.

``split=bench`` compares methods while they are made; ``split=sealed`` is for published figures: nothing is
chosen by it. ``<split>.json`` has what they are made from: numbers of the people, seed, cameras, lights,
rays. The code that makes people may change, so ``<split>.npz`` has what they look like: 16 x 16 pixels of two
photographs and masks of each person. These are compared within a tolerance, since processors round rays and
JPEG files differently and people can be rendered at any size; a digest of the photographs would not hold.
Whoever changes how people are made, so that these look different, bakes another version
(``scripts/bake_bench.py``).
"""

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ghgs_lit.config.keys import flatten
from ghgs_lit.data.reader import Reader
from ghgs_lit.data.sampling import RING_VIEW
from ghgs_lit.data.view import View
from ghgs_lit.errors import InputError, require

SPLITS = ("bench", "sealed")
#: First letter of the names of people who stand or walk, and of those in poses of sport and dance.
KINDS = {"people": "p", "active": "a"}
FOLDER = Path(__file__).parent
#: Ring positions of the photographs that are compared: front and back.
POSITIONS = (0, 8)
SIDE = 16
#: Greatest root mean square of the difference of two thumbnails, of 255 levels: at the size at which the
#: stored ones were rendered (0 where they were made), and at others (5.7 at 56 pixels).
SAME_SIZE, OTHER_SIZE = 0.3, 8.0
#: Pixels of the longer side that tell people apart.
LEAST = 56


@cache
def definition(split: str) -> dict[str, Any]:
    """What the people of one of ``SPLITS`` are made from, as plain data."""
    return json.loads((FOLDER / f"{split}.json").read_text())


def names(split: str) -> list[str]:
    """The subjects."""
    made = definition(split)
    return [
        f"{letter}{made['first'] + i:07d}" for kind, letter in KINDS.items() for i in range(made.get(kind, 0))
    ]


@cache
def thumbnails(split: str) -> np.ndarray:
    """[people, positions, SIDE, SIDE, 4] uint8: colours, and the mask."""
    return np.load(FOLDER / f"{split}.npz")["thumbnails"]


@cache
def facts(split: str) -> dict[str, str]:
    """Version and digest, for results."""
    made = json.dumps(definition(split), sort_keys=True).encode()
    digest = hashlib.sha256(made + thumbnails(split).tobytes()).hexdigest()
    return {split: f"version {definition(split)['version']}, {digest[:12]}"}


def check_settings(split: str, settings: Mapping[str, Any]) -> None:
    """Refuse other settings than those of the definition. ``settings``: of ``data``, by key; those that the
    definition does not name are free, such as the size. InputError: names the first key that differs."""
    found = flatten(json.loads(json.dumps(settings)))  # tuples to lists
    size = max(settings["render"]["size"])
    require(size >= LEAST, "data.size", f"{LEAST} pixels or more with split={split}", size)
    for key, expected in flatten(definition(split)["data"]).items():
        text = f"{expected}, with which split={split} (version {definition(split)['version']}) is defined"
        require(found.get(key) == expected, f"data.{key}", text, found.get(key))


def thumbnail(view: View) -> np.ndarray:
    """[SIDE, SIDE, 4] uint8 of a photograph of any size."""
    picture = Image.fromarray(np.dstack((view.image, view.mask.astype(np.uint8) * 255)), "RGBA")
    # Bands of their own: PIL would weigh colours by the mask.
    bands = [band.resize((SIDE, SIDE), Image.Resampling.BOX) for band in picture.split()]
    return np.stack([np.asarray(band) for band in bands], -1)


def check_photographs(split: str, reader: Reader) -> None:
    """Refuse photographs of other people than those of the definition. ``reader``: of all of :func:`names`,
    or of some. InputError: names the first person whose photographs differ."""
    made, known = definition(split), dict(zip(names(split), thumbnails(split), strict=True))
    for name in reader.subjects:
        for position, expected in zip(POSITIONS, known[name], strict=True):
            view = reader.read_view(name, position, RING_VIEW, depth=False)
            difference = float(np.sqrt(np.square(thumbnail(view).astype(float) - expected).mean()))
            tolerance = SAME_SIZE if set(view.mask.shape) == {made["size"]} else OTHER_SIZE
            if difference > tolerance:
                raise InputError(
                    f"{reader.place(name, position, RING_VIEW)}: expected {name} of split={split} (version "
                    f"{made['version']}), up to {tolerance:g} of 255 levels; found {difference:.1f} "
                    "(this version of the package makes other people, or the cache was changed: delete it)"
                )
