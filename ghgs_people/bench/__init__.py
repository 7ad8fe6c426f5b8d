"""Frozen people of ``data=synthetic``: the same for all measurements, never used in training.

``split=bench`` compares methods during development; ``split=sealed`` is for published figures only, not
for choices. ``<split>.json`` defines numbers of people, seed, cameras, lights and rays. Since the code that
generates people may change, ``<split>.npz`` contains thumbnails: 16 x 16 pixels of two photographs and
masks of each person. They are compared within a tolerance, not by a digest of the photographs: processors
round rays and JPEG files differently, and people can be rendered at any size. After a change of their
appearance, a new version must be baked (``scripts/bake_bench.py``)."""

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
#: First letters of names of people who stand or walk, and of people in poses of sport and dance
KINDS = {"people": "p", "active": "a"}
FOLDER = Path(__file__).parent
#: Ring positions of the compared photographs: front and back
POSITIONS = (0, 8)
SIDE = 16
#: Largest root mean square difference of two thumbnails, in levels of 255, at the size of the stored ones
#: (0 on the machine that rendered them)
SAME_SIZE = 0.3
#: The same at other sizes (6.8 at 56 pixels)
OTHER_SIZE = 8.0
#: Least longer side in pixels at which people can be distinguished
LEAST = 56


@cache
def definition(split: str) -> dict[str, Any]:
    """Read ``<split>.json``, the definition of the people of a split (one of ``SPLITS``)."""
    return json.loads((FOLDER / f"{split}.json").read_text())


def names(split: str) -> list[str]:
    """Names of a split's subjects, in the order of its thumbnails, such as ``p2000000``: the letter of the
    kind and the number of the person."""
    defined = definition(split)
    listed = []
    for kind, letter in KINDS.items():
        listed += [f"{letter}{defined['first'] + i:07d}" for i in range(defined.get(kind, 0))]
    return listed


@cache
def thumbnails(split: str) -> np.ndarray:
    """Read the stored thumbnails of a split.

    Returns:
        [people, positions, SIDE, SIDE, 4] uint8: colours and mask, positions as in ``POSITIONS``.
    """
    return np.load(FOLDER / f"{split}.npz")["thumbnails"]


@cache
def facts(split: str) -> dict[str, str]:
    """Version of a split, for results.

    Returns:
        Version and first 12 digits of the SHA-256 of definition and thumbnails, by name of the split.
    """
    defined = json.dumps(definition(split), sort_keys=True).encode()
    digest = hashlib.sha256(defined + thumbnails(split).tobytes()).hexdigest()
    return {split: f"version {definition(split)['version']}, {digest[:12]}"}


def check_settings(split: str, settings: Mapping[str, Any]) -> None:
    """Check that settings of ``data`` match the definition; others, such as the size, are free.

    Args:
        split: one of ``SPLITS``.
        settings: settings of the data set as nested plain data; ``render.size`` is [height, width] in
            pixels.

    Raises:
        InputError: a setting differs (the message names the first key), or the longer side is below
            ``LEAST`` pixels.
    """
    given = flatten(json.loads(json.dumps(settings)))  # tuples to lists
    size = max(settings["render"]["size"])
    require(size >= LEAST, "data.size", f"{LEAST} pixels or more with split={split}", size)
    for key, expected in flatten(definition(split)["data"]).items():
        text = f"{expected}, with which split={split} (version {definition(split)['version']}) is defined"
        require(given.get(key) == expected, f"data.{key}", text, given.get(key))


def thumbnail(view: View) -> np.ndarray:
    """Downsample a photograph and its mask.

    Returns:
        [SIDE, SIDE, 4] uint8: colours and mask, each pixel the mean of its box.
    """
    picture = Image.fromarray(np.dstack((view.image, view.mask.astype(np.uint8) * 255)), "RGBA")
    # Each band separately, since PIL would weight colours by the mask.
    bands = [band.resize((SIDE, SIDE), Image.Resampling.BOX) for band in picture.split()]
    return np.stack([np.asarray(band) for band in bands], -1)


def check_photographs(split: str, reader: Reader) -> None:
    """Check that photographs show the people of the definition.

    Args:
        split: one of ``SPLITS``.
        reader: reader of some or all of :func:`names`.

    Raises:
        InputError: a person's photographs differ; the message names the first one.
    """
    defined = definition(split)
    known = dict(zip(names(split), thumbnails(split), strict=True))
    for name in reader.subjects:
        for position, expected in zip(POSITIONS, known[name], strict=True):
            view = reader.read_view(name, position, RING_VIEW, depth=False)
            difference = float(np.sqrt(np.square(thumbnail(view).astype(float) - expected).mean()))
            tolerance = SAME_SIZE if set(view.mask.shape) == {defined["size"]} else OTHER_SIZE
            if difference > tolerance:
                raise InputError(
                    f"{reader.place(name, position, RING_VIEW)}: expected {name} of split={split} (version "
                    f"{defined['version']}), up to {tolerance:g} of 255 levels; found {difference:.1f} "
                    "(this version of the package makes other people, or the cache was changed: delete it)"
                )
