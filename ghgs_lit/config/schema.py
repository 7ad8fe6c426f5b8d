"""The type and range of every key of a configuration, checked before any work starts.

``KINDS`` has an entry for each key of each option in ``conf``, by dotted key; ``*`` stands for any name.
Which names an option such as ``recalibration.similarity`` knows, and what several keys must fulfil together,
is checked where it is implemented. Keys without an entry are those of the user's own classes.
"""

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from ghgs_lit.errors import require

_LIMITS = {
    "least": (">=", operator.ge),
    "most": ("<=", operator.le),
    "above": (">", operator.gt),
    "below": ("<", operator.lt),
}


@dataclass(frozen=True)
class Kind:
    """What a value must be: in words for messages, and as a test. ``a | b`` holds where one of both does."""

    expected: str
    holds: Callable[[Any], bool]

    def __or__(self, other: "Kind") -> "Kind":
        return Kind(
            f"{self.expected} or {other.expected}", lambda value: self.holds(value) or other.holds(value)
        )


def _limited(noun: str, types: type | tuple[type, ...], limits: Mapping[str, float]) -> Kind:
    """A finite number of ``types`` within ``limits`` (names of ``_LIMITS``)."""

    def holds(value: Any) -> bool:
        if not isinstance(value, types) or isinstance(value, bool):
            return False
        finite = isinstance(value, int) or math.isfinite(value)
        return finite and all(_LIMITS[name][1](value, limit) for name, limit in limits.items())

    words = " and ".join(f"{_LIMITS[name][0]} {limit}" for name, limit in limits.items())
    return Kind(f"{noun} {words}".strip(), holds)


def integer(**limits: int) -> Kind:
    """An integer (not true or false) within ``limits``: ``least``, ``most``, ``above``, ``below``."""
    return _limited("an integer", int, limits)


def number(**limits: float) -> Kind:
    """A finite number (not true or false) within ``limits``, as for :func:`integer`."""
    return _limited("a number", (int, float), limits)


def one_of(*names: str | int) -> Kind:
    """One of ``names``."""
    words = "one of " * (len(names) > 1) + ", ".join(map(str, names))
    return Kind(words, lambda value: not isinstance(value, bool) and value in names)


def list_of(kind: Kind, length: int | None = None) -> Kind:
    """A list of ``length`` (None: any) values, each of ``kind``."""
    return Kind(
        f"a list{'' if length is None else f' of {length} values'} (each {kind.expected})",
        lambda value: (
            isinstance(value, list) and length in (None, len(value)) and all(map(kind.holds, value))
        ),
    )


def mapping_of(**kinds: Kind) -> Kind:
    """A mapping with exactly these keys."""
    words = ", ".join(f"{name}: {kind.expected}" for name, kind in kinds.items())
    return Kind(
        f"a mapping ({words})",
        lambda value: (
            isinstance(value, Mapping)
            and set(value) == set(kinds)
            and all(kind.holds(value[name]) for name, kind in kinds.items())
        ),
    )


def text_like(pattern: str, expected: str) -> Kind:
    """A text that matches the regular expression ``pattern`` as a whole."""
    return Kind(expected, lambda value: isinstance(value, str) and re.fullmatch(pattern, value) is not None)


NULL = Kind("null", lambda value: value is None)
FLAG = Kind("true or false", lambda value: isinstance(value, bool))
ANY_TEXT = Kind("a text", lambda value: isinstance(value, str))
TEXT = Kind("a text", lambda value: isinstance(value, str) and value != "")
PATH = Kind("a path", TEXT.holds) | NULL
COUNT = integer(least=1)
AMOUNT = number(least=0)
POSITIVE = number(above=0)
SHARE = number(least=0, most=1)
SEED = integer(least=0, most=2**32 - 1)
TEXTS = list_of(TEXT)
POSITIONS = list_of(integer(least=0))
WORKERS = integer(least=0, most=1024)
# A photograph of more pixels would need gigabytes before anything could refuse it.
SIDE = integer(least=1, most=8192)
SIZE = SIDE | list_of(SIDE, 2)
WIDTH = integer(least=1, most=65536)
FRAMES = list_of(integer(least=0), 3)

KINDS: dict[str, Kind] = {
    # verbs
    "allow_random_encoder": FLAG,
    "baselines": TEXT | TEXTS,
    "backgrounds": PATH,
    "by": TEXT | TEXTS | NULL,
    "calibration.axes": TEXT | NULL,
    "calibration.exif": TEXT,
    "calibration.extrinsics": TEXT | NULL,
    "calibration.format": TEXT,
    "calibration.intrinsics": TEXT | NULL,
    "calibration.names": NULL | Kind("a mapping of photographs to cameras", lambda v: isinstance(v, Mapping)),
    "calibration.pixel_centers": TEXT | NULL,
    "calibration.resized": POSITIVE | NULL,
    "calibration.unit": POSITIVE | NULL,
    "cameras": PATH,
    "check_cameras": FLAG,
    "check.min_agreement": SHARE,
    "check.min_iou": SHARE,
    "checkpoint": PATH,
    "columns": TEXT | TEXTS | NULL,
    "depth_head_start": one_of("fresh", "vggt"),
    "device": TEXT,
    "dry_run": FLAG,
    "dtype": one_of("float32", "bfloat16", "float16"),
    "formats": TEXT | TEXTS,
    "host": TEXT,
    "dtypes": TEXTS | NULL,
    "families": TEXTS | NULL,
    "quick": FLAG,
    "stages": TEXTS | NULL,
    "workers": WORKERS | NULL,
    "illustration": FLAG,
    "images": PATH,
    "inference": PATH,
    "init_from": PATH,
    "init_strict": FLAG,
    "knobs": NULL | Kind("a mapping of lists", lambda value: isinstance(value, Mapping)),
    "layout": TEXT,
    "masks": PATH,
    "miniature.people.*": integer(least=0),
    "miniature.size": SIDE,
    "others": TEXT | TEXTS | NULL,
    "out": PATH,
    "path": PATH,
    "port": integer(least=0, most=65535),
    "precision": TEXT,
    "print_config": FLAG,
    "release": PATH,
    "reported": FLAG,
    "overwrite": FLAG,
    "presets": TEXTS,
    "resume": PATH,
    "scaling.base.batch": COUNT,
    "scaling.base.share": SHARE,
    "scaling.base.size": SIDE,
    "scaling.base.views": integer(least=2),
    "scaling.batch": list_of(COUNT),
    "scaling.share": list_of(SHARE),
    "scaling.size": list_of(SIDE),
    "scaling.threads": list_of(COUNT),
    "scaling.views": list_of(integer(least=2)),
    "runs": TEXT | Kind("a list of paths", lambda value: TEXTS.holds(value) and len(value) > 0),
    "seconds": POSITIVE | NULL,
    "seed": SEED,
    "segment": TEXT | NULL,
    "size": SIZE | NULL,
    "smooth": FLAG,
    "splats.opacity": SHARE,
    "splats.sigma": POSITIVE,
    "split": TEXT,
    "subject": TEXT | integer(least=0),
    "subjects": COUNT,
    "task": TEXT,
    "threads": COUNT | NULL,
    "timing.count_flops": FLAG,
    "timing.repeats": COUNT,
    "timing.warmup": integer(least=0),
    "vs": PATH,
    "test.against": TEXT,
    "test.alpha": number(above=0, below=1),
    "test.kind": TEXT,
    "test.unit": TEXT | NULL,
    "token_budgets": list_of(one_of("all", "window") | integer(least=0)) | NULL,
    "turntable.fps": COUNT,
    "turntable.frames": integer(least=0),
    "up": TEXT | NULL,
    "vggt": PATH,
    # data
    "data": NULL,
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
    # the model
    "bounds.cells": integer(least=8, most=512),
    "bounds.dilation": number(least=0, below=0.5),
    "bounds.margin": AMOUNT,
    "bounds.resolution": integer(least=8, most=8192),
    "bounds.samples": integer(least=2, most=4096),
    "bounds.tolerance": integer(least=0),
    "compat.name": TEXT,
    "depth_head.consistency_depths": integer(least=0, most=4096),
    "depth_head.dpt.features": WIDTH | NULL,
    "depth_head.dpt.out_channels": list_of(WIDTH, 4) | NULL,
    "depth_head.guide": FLAG,
    "depth_head.parameterization": TEXT,
    "depth_head.pixels": TEXT,
    "depth_head.start": number(above=0, below=1),
    "encoder.bounds_input": FLAG,
    "encoder.checkpointing": FLAG,
    "encoder.depth": integer(least=1, most=1024),
    "encoder.heads": WIDTH,
    "encoder.image_size": SIDE,
    "encoder.layer_scale": number(),
    "encoder.layers": POSITIONS,
    "encoder.margin": integer(least=0),
    "encoder.mask_input": FLAG,
    "encoder.tokens": TEXT,
    "encoder.patch_size": integer(least=1, most=1024),
    "encoder.registers": integer(least=0, most=1024),
    "encoder.trainable": text_like(r"all|none|last_\d+", "all, none or last_<n>"),
    "encoder.vit.channels": WIDTH,
    "encoder.vit.depth": integer(least=1, most=1024),
    "encoder.vit.heads": WIDTH,
    "encoder.vit.kind": TEXT,
    "encoder.weights": TEXT | NULL,
    "encoder.width": WIDTH,
    "gaussian_head.attributes.offset_limit": AMOUNT,
    "gaussian_head.attributes.opacity_*": SHARE,
    "gaussian_head.attributes.scale_*": POSITIVE,
    "gaussian_head.channels": WIDTH,
    "gaussian_head.color_limit": SHARE,
    "gaussian_head.dpt.features": WIDTH | NULL,
    "gaussian_head.dpt.out_channels": list_of(WIDTH, 4) | NULL,
    "gaussian_head.guide": FLAG,
    "gaussian_head.hidden": list_of(WIDTH, 2),
    "gaussian_head.parameterization": TEXT,
    "gaussian_head.photo_consistency": FLAG,
    "gaussian_head.pixels": TEXT,
    "model.check_inputs": FLAG,
    "model.name": TEXT,
    "model.pad": TEXT,
    "recalibration.k": COUNT,
    "recalibration.neighborhood": TEXT,
    "recalibration.neighbors": TEXT,
    "recalibration.num_heads": WIDTH,
    "recalibration.s_min": number(above=0, most=1),
    "recalibration.similarity": TEXT,
    "recalibration.tokens": TEXT,
    "skip.budget_db": number() | NULL,
    "skip.choices.*.budget_db": number() | NULL,
    "skip.choices.*.crop": FLAG,
    "skip.choices.*.depth_pixels.*": TEXT,
    "skip.choices.*.margin": integer(least=0),
    "skip.choices.*.max_rel_diff": AMOUNT | NULL,
    "skip.choices.*.name": TEXT,
    "skip.choices.*.pixels": TEXT,
    "skip.choices.*.tokens": TEXT,
    "skip.crop": FLAG,
    "skip.depth_pixels.*": TEXT,
    "skip.margin": integer(least=0),
    "skip.max_rel_diff": AMOUNT | NULL,
    "skip.name": TEXT,
    "skip.pixels": TEXT,
    "skip.tokens": TEXT,
    "unprojection.border": integer(least=0),
    "unprojection.tokens": TEXT,
    # rendering, loss, optimizer
    "loss.chamfer": TEXT,
    "loss.chamfer_points": COUNT | NULL,
    "loss.chamfer_scale": POSITIVE,
    "loss.depth": TEXT,
    "loss.weights.*": AMOUNT,
    "optimizer.betas": list_of(number(least=0, below=1), 2),
    "optimizer.clip": POSITIVE,
    "optimizer.end_factor": SHARE,
    "optimizer.eps": POSITIVE,
    "optimizer.freeze_until.*": SHARE,
    "optimizer.lr": POSITIVE,
    "optimizer.start_factor": SHARE,
    "optimizer.warmup": number(least=0, below=1),
    "optimizer.weight_decay": AMOUNT,
    "renderer.alpha_max": SHARE,
    "renderer.antialiased": FLAG,
    "renderer.backend": TEXT,
    "renderer.background": number() | list_of(number()),
    "renderer.far": POSITIVE,
    "renderer.near": POSITIVE,
    # training: the Trainer refuses a wrong value with a traceback, or not at all
    "trainer.accelerator": TEXT,
    "trainer.accumulate_grad_batches": COUNT,
    "trainer.benchmark": FLAG | NULL,
    "trainer.check_val_every_n_epoch": COUNT | NULL,
    "trainer.deterministic": FLAG | one_of("warn"),
    "trainer.devices": COUNT | list_of(integer(least=0)) | one_of(-1, "auto"),
    "trainer.enable_model_summary": FLAG,
    "trainer.limit_val_batches": integer(least=0) | SHARE,
    "trainer.log_every_n_steps": integer(least=0),
    "trainer.max_epochs": integer(least=-1) | NULL,
    "trainer.max_steps": integer(least=-1),
    "trainer.max_time": text_like(r"\d+(:\d+){3}", "days:hours:minutes:seconds such as 00:00:10:00") | NULL,
    "trainer.max_time.*": AMOUNT,
    "trainer.num_sanity_val_steps": integer(least=-1),
    "trainer.precision": TEXT | one_of(16, 32, 64),
    "trainer.strategy": TEXT,
    "trainer.use_distributed_sampler": FLAG,
    "trainer.val_check_interval": COUNT | number(above=0, most=1),
    "callbacks.*.every_n_train_steps": integer(least=0) | NULL,
    "callbacks.*.filename": TEXT,
    "callbacks.*.minutes": POSITIVE | NULL,
    "callbacks.*.mode": one_of("max", "min"),
    "callbacks.*.monitor": TEXT | NULL,
    "callbacks.*.points": COUNT,
    "callbacks.*.save_on_train_epoch_end": FLAG | NULL,
    "callbacks.*.save_top_k": integer(least=-1),
    "callbacks.*.subjects": integer(least=0),
    "callbacks.*.token": list_of(integer(least=0), 3) | NULL,
    "logger.*.name": ANY_TEXT,
    "logger.*.offline": FLAG,
    "logger.*.project": TEXT,
    "logger.*.version": ANY_TEXT | integer(least=0) | NULL,
    "feature_cache.directory": PATH,
    "feature_cache.dtype": TEXT,
    "feature_cache.margin": integer(least=0),
    "feature_cache.max_gb": POSITIVE | NULL,
    "feature_cache.tokens": TEXT,
    # evaluation; ghgs table takes one value in place of a list
    "evaluation.pictures": integer(least=0),
    "evaluation.split": TEXT,
    "evaluation.targets": TEXT | TEXTS | NULL,
    "evaluation.views": integer(least=2) | list_of(integer(least=2)) | NULL,
    "metrics.box_margin": AMOUNT,
    "metrics.clamp": FLAG,
    "metrics.flip_pixels_per_degree": POSITIVE,
    "metrics.lpips": TEXT,
    "metrics.lpips_net": TEXT,
    "metrics.lpips_signed": FLAG,
    "metrics.protocol": TEXT,
    "metrics.regions": TEXTS,
    "metrics.ssim_padding": TEXT,
}


def kind_of(key: str) -> Kind | None:
    """The entry of a dotted key in ``KINDS``, None where there is none."""
    if key.endswith("_target_"):
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
    target = config.get("_target_")
    if isinstance(target, str) and not target.startswith(("ghgs_lit.", "lightning.")):
        return  # a class of the user's own, whose keys may mean anything
    # Nodes last: data.render.size repeats data.size, and a message about it would puzzle.
    for name, value in sorted(config.items(), key=lambda item: isinstance(item[1], Mapping)):
        key = f"{parent}.{name}" if parent else str(name)
        kind, node = kind_of(key), is_node(key)
        if isinstance(value, Mapping) and (node or kind is None):
            check(value, key)
        elif kind is not None:
            require(kind.holds(value), key, kind.expected, value)
        elif node:
            require(False, key, "a mapping of its keys", value)
