"""Frozen people of ``data=synthetic``: the same ones for all measurements, and for no training.

``split=bench`` compares methods during development; ``split=sealed`` is for published figures only, not for
choices. ``<split>.json`` defines them: numbers of the people, seed, cameras, lights, rays. The code that
generates people may change, so ``<split>.npz`` has thumbnails: 16 x 16 pixels of two photographs and masks of
each person. These are compared within a tolerance: processors round rays and JPEG files differently and
people can be rendered at any size, so a digest of the photographs would not match. After a change of how they
look, a new version must be baked (``scripts/bake_bench.py``)."""

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
#: First letters of names: people who stand or walk, and people in poses of sport and dance.
KINDS = {"people": "p", "active": "a"}
FOLDER = Path(__file__).parent
#: Ring positions of the photographs that are compared: front and back.
POSITIONS = (0, 8)
SIDE = 16
#: Largest root mean square difference of two thumbnails, of 255 levels, at the size of the stored ones (it is
#: 0 on the machine that made them).
SAME_SIZE = 0.3
#: The same at other sizes (it is 5.7 at 56 pixels).
OTHER_SIZE = 8.0
#: Smallest longer side in pixels at which people can be told apart.
LEAST = 56


@cache
def definition(split: str) -> dict[str, Any]:
    """The definition of the people of one of ``SPLITS``, as plain data."""
    return json.loads((FOLDER / f"{split}.json").read_text())


def names(split: str) -> list[str]:
    """Names of the subjects of a split."""
    made = definition(split)
    return [
        f"{letter}{made['first'] + i:07d}" for kind, letter in KINDS.items() for i in range(made.get(kind, 0))
    ]


@cache
def thumbnails(split: str) -> np.ndarray:
    """Thumbnails [people, positions, SIDE, SIDE, 4] uint8: colours and mask."""
    return np.load(FOLDER / f"{split}.npz")["thumbnails"]


@cache
def facts(split: str) -> dict[str, str]:
    """Version and digest of a split, for results."""
    made = json.dumps(definition(split), sort_keys=True).encode()
    digest = hashlib.sha256(made + thumbnails(split).tobytes()).hexdigest()
    return {split: f"version {definition(split)['version']}, {digest[:12]}"}


def check_settings(split: str, settings: Mapping[str, Any]) -> None:
    """Refuse settings of ``data`` that differ from the definition; those that it does not name, such as the
    size, are free. InputError: names the first key that differs."""
    found = flatten(json.loads(json.dumps(settings)))  # tuples to lists
    size = max(settings["render"]["size"])
    require(size >= LEAST, "data.size", f"{LEAST} pixels or more with split={split}", size)
    for key, expected in flatten(definition(split)["data"]).items():
        text = f"{expected}, with which split={split} (version {definition(split)['version']}) is defined"
        require(found.get(key) == expected, f"data.{key}", text, found.get(key))


def thumbnail(view: View) -> np.ndarray:
    """The thumbnail [SIDE, SIDE, 4] uint8 of a photograph of any size."""
    picture = Image.fromarray(np.dstack((view.image, view.mask.astype(np.uint8) * 255)), "RGBA")
    # Each band by itself: PIL would weight colours by the mask.
    bands = [band.resize((SIDE, SIDE), Image.Resampling.BOX) for band in picture.split()]
    return np.stack([np.asarray(band) for band in bands], -1)


def check_photographs(split: str, reader: Reader) -> None:
    """Refuse photographs that do not show the people of the definition. ``reader``: of some or all of
    :func:`names`. InputError: names the first person whose photographs differ."""
    made = definition(split)
    known = dict(zip(names(split), thumbnails(split), strict=True))
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
