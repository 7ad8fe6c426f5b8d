"""The people of ``data=synthetic split=bench``: nobody trains on them, and everybody measures the same ones.

``definition.json`` has what they are made from: numbers of the people, seed, cameras, lights, rays. The code
that makes people may change, so ``thumbnails.npz`` has what they look like: 16 x 16 pixels of two photographs
and masks of each person. These are compared within a tolerance, since processors round rays and JPEG files
differently and people can be rendered at any size; a digest of the photographs would not hold. Whoever
changes how people are made, so that these look different, bakes another version (``scripts/bake_bench.py``).
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

SPLIT = "bench"
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
def definition() -> dict[str, Any]:
    """What the people are made from, as plain data."""
    return json.loads((FOLDER / "definition.json").read_text())


def names() -> list[str]:
    """The subjects."""
    first = definition()["first"]
    return [f"p{first + i:07d}" for i in range(definition()["people"])]


@cache
def thumbnails() -> np.ndarray:
    """[people, positions, SIDE, SIDE, 4] uint8: colours, and the mask."""
    return np.load(FOLDER / "thumbnails.npz")["thumbnails"]


@cache
def facts() -> dict[str, str]:
    """Version and digest, for results."""
    digest = hashlib.sha256(json.dumps(definition(), sort_keys=True).encode() + thumbnails().tobytes())
    return {"bench": f"version {definition()['version']}, {digest.hexdigest()[:12]}"}


def check_settings(settings: Mapping[str, Any]) -> None:
    """Refuse other settings than those of the definition. ``settings``: of ``data``, by key; those that the
    definition does not name are free, such as the size. InputError: names the first key that differs."""
    found = flatten(json.loads(json.dumps(settings)))  # tuples to lists
    size = max(settings["render"]["size"])
    require(size >= LEAST, "data.size", f"{LEAST} pixels or more with split={SPLIT}", size)
    for key, expected in flatten(definition()["data"]).items():
        text = f"{expected}, with which split={SPLIT} (version {definition()['version']}) is defined"
        require(found.get(key) == expected, f"data.{key}", text, found.get(key))


def thumbnail(view: View) -> np.ndarray:
    """[SIDE, SIDE, 4] uint8 of a photograph of any size."""
    picture = Image.fromarray(np.dstack((view.image, view.mask.astype(np.uint8) * 255)), "RGBA")
    # Bands of their own: PIL would weigh colours by the mask.
    bands = [band.resize((SIDE, SIDE), Image.Resampling.BOX) for band in picture.split()]
    return np.stack([np.asarray(band) for band in bands], -1)


def check_photographs(reader: Reader) -> None:
    """Refuse photographs of other people than those of the definition. ``reader``: of all of :func:`names`,
    or of some. InputError: names the first person whose photographs differ."""
    known = dict(zip(names(), thumbnails(), strict=True))
    for name in reader.subjects:
        for position, expected in zip(POSITIONS, known[name], strict=True):
            view = reader.read_view(name, position, RING_VIEW, depth=False)
            difference = float(np.sqrt(np.square(thumbnail(view).astype(float) - expected).mean()))
            tolerance = SAME_SIZE if set(view.mask.shape) == {definition()["size"]} else OTHER_SIZE
            if difference > tolerance:
                raise InputError(
                    f"{reader.place(name, position, RING_VIEW)}: expected {name} of split={SPLIT} (version "
                    f"{definition()['version']}), up to {tolerance:g} of 255 levels; found {difference:.1f} "
                    "(this version of the package makes other people, or the cache was changed: delete it)"
                )
