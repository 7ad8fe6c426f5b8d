"""The type and range of every key of a configuration, checked before any work starts.

``KINDS`` has an entry for each key of each option in ``conf``, by dotted key; ``*`` stands for any name.
Which names an option such as ``recalibration.similarity`` knows, and what several keys must fulfil together,
is checked where it is implemented. Keys without an entry are those of the user's own classes.
"""

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Any

from ghgs_lit.config.kinds import (
    AMOUNT,
    COUNT,
    FLAG,
    FRAMES,
    NULL,
    PATH,
    POSITIONS,
    POSITIVE,
    SHARE,
    SIZE,
    TEXT,
    TEXTS,
    WORKERS,
    Kind,
    integer,
    list_of,
    mapping_of,
    number,
    one_of,
)
from ghgs_lit.config.registry import is_typed
from ghgs_lit.config.schema_model import MODEL
from ghgs_lit.errors import require

KINDS: dict[str, Kind] = {
    # data
    "data": NULL,
    "data.active.*": integer(least=0),
    "data.apply_mask": FLAG,
    "data.batch_size": COUNT,
    "data.bodies": TEXTS,
    "data.body": TEXT,
    "data.body_model": PATH,
    "data.body_models": TEXTS,
    "data.body_vertices": COUNT | NULL,
    "data.cache_dir": PATH,
    "data.cache_images_mb": AMOUNT,
    "data.cameras": integer(least=2) | NULL,
    "data.depths": FLAG,
    "data.evaluation_positions": NULL,
    "data.evaluation_positions.*": POSITIONS,
    "data.fits": PATH,
    "data.frames": FRAMES,
    "data.limit": NULL,
    "data.limit.*": COUNT | NULL,
    "data.masks": TEXT | TEXTS,
    "data.name": TEXT,
    "data.people.*": COUNT,
    "data.people_seed": integer(least=0),
    "data.pin_memory": FLAG,
    "data.pixel_centers": TEXT,
    "data.render.lights.ambient": SHARE,
    "data.render.lights.count": COUNT,
    "data.render.lights.elevation": number(least=-90, most=90),
    "data.render.lights.exposure": POSITIVE,
    "data.render.lights.jitter": number(least=0, below=1),
    "data.render.lights.softness": SHARE,
    "data.render.positions": POSITIONS | NULL,
    "data.render.quality": integer(least=1, most=100),
    "data.render.samples": integer(least=1, most=16),
    "data.render.size": SIZE,
    "data.render.views": POSITIONS,
    "data.render_seed": integer(least=0),
    "data.render_workers": WORKERS | NULL,
    "data.rig.focal": POSITIVE,
    "data.rig.height": POSITIVE | NULL,
    "data.rig.height_jitter": AMOUNT,
    "data.rig.look_at": list_of(number(), 3),
    "data.rig.pitch": number(above=-89, below=89),
    "data.rig.positions": integer(least=2),
    "data.rig.radius": POSITIVE,
    "data.rig.shift_y": number(),
    "data.rig.variation.between_pitch": number(least=0, below=45),
    "data.rig.variation.camera_look_at": AMOUNT,
    "data.rig.variation.camera_pitch": number(least=0, below=45),
    "data.rig.variation.camera_roll": number(least=0, most=180),
    "data.rig.variation.fill": list_of(number(above=0, below=1), 2) | NULL,
    "data.rig.variation.pitch": list_of(number(above=-89, below=89), 2) | NULL,
    "data.rig.variation.radius": list_of(POSITIVE, 2) | NULL,
    "data.rig.yaw_jitter": AMOUNT,
    "data.ring": integer(least=2),
    "data.resampling": TEXT,
    "data.root": PATH,
    "data.size": SIZE,
    "data.smpl_model": PATH,
    "data.source": PATH,
    "data.split": PATH,
    "data.split.*": list_of(TEXT | integer(least=0)) | NULL,
    "data.splits.*": list_of(mapping_of(sequences=list_of(TEXT | integer(least=0)), frames=FRAMES)),
    "data.steps_per_epoch": COUNT | NULL,
    "data.target_size": SIZE | NULL,
    "data.undistorted": FLAG,
    "data.val_fraction": number(least=0, below=1),
    "data.workers": WORKERS,
    "augmentation.background": SHARE,
    "augmentation.calibration": AMOUNT,
    "augmentation.chance": SHARE,
    "augmentation.exposure": AMOUNT,
    "augmentation.mask_hole": AMOUNT,
    "augmentation.mask_hole_chance": SHARE,
    "augmentation.mask_offset": AMOUNT,
    "augmentation.mask_ragged": AMOUNT,
    "augmentation.refined": SHARE,
    "augmentation.sizes": list_of(SIZE) | NULL,
    "augmentation.target_scale": list_of(POSITIVE, 2) | NULL,
    "augmentation.white_balance": AMOUNT,
    "targets.kind": TEXT | NULL,
    "targets.name": TEXT,
    "targets.per_step": COUNT,
    "targets.per_subject": COUNT | one_of("all"),
    "targets.positions": POSITIONS | NULL,
    "targets.training_views": POSITIONS,
    "targets.view": integer(least=0),
    "views.evaluation_count": integer(least=2),
    "views.name": TEXT,
    "views.training": TEXT,
    "views.training_counts": list_of(integer(least=2)),
    **MODEL,
}


def kind_of(key: str) -> Kind | None:
    """The entry of a dotted key in ``KINDS``, None where there is none."""
    if key.endswith(".kind") and key not in KINDS:
        return TEXT
    return next((kind for pattern, kind in KINDS.items() if fnmatchcase(key, pattern)), None)


def is_node(key: str) -> bool:
    """Whether ``KINDS`` has keys below ``key``."""
    depth = key.count(".") + 1
    return any(
        fnmatchcase(key, ".".join(pattern.split(".")[:depth]))
        for pattern in KINDS
        if pattern.count(".") >= depth
    )


def check(config: Mapping[str, Any], parent: str = "") -> None:
    """Refuse a value of the wrong type or range.

    Args:
        config: plain data, interpolations resolved.
        parent: the dotted key of ``config`` in the whole configuration.

    Raises:
        InputError: names the key, what was expected and what was found.
    """
    # Nodes last: data.render.size repeats data.size, and a message about it would puzzle.
    for name, value in sorted(config.items(), key=lambda item: isinstance(item[1], Mapping)):
        key = f"{parent}.{name}" if parent else str(name)
        if is_typed(key, value):
            continue
        kind, node = kind_of(key), is_node(key)
        if isinstance(value, Mapping) and (node or kind is None):
            check(value, key)
        elif kind is not None:
            require(kind.holds(value), key, kind.expected, value)
        elif node:
            require(False, key, "a mapping of its keys", value)
