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
    ANY_TEXT,
    COUNT,
    FLAG,
    NULL,
    PATH,
    POSITIVE,
    SEED,
    SHARE,
    SIDE,
    SIZE,
    TEXT,
    TEXTS,
    WORKERS,
    Kind,
    integer,
    list_of,
    number,
    one_of,
    text_like,
)
from ghgs_lit.config.registry import is_typed
from ghgs_lit.config.schema_model import MODEL
from ghgs_lit.errors import require

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
    "gpu_memory": POSITIVE | NULL,
    "dry_run": FLAG,
    "dump": PATH,
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
    "peers.baselines": TEXT | TEXTS,
    "peers.targets": TEXTS,
    "peers.views": list_of(integer(least=2)),
    "per_scene.start": TEXT,
    "per_scene.steps": COUNT,
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
    "share": SHARE,
    "size": SIZE | NULL,
    "smooth": FLAG,
    "splats.opacity": SHARE,
    "splats.sigma": POSITIVE,
    "split": TEXT,
    "subject": TEXT | integer(least=0),
    "subjects": COUNT | NULL,
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
    **MODEL,
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
    "optimizer.matrix_lr": POSITIVE | NULL,
    "optimizer.skip_nonfinite": integer(least=0),
    "optimizer.start_factor": SHARE,
    "optimizer.warmup": number(least=0, below=1),
    "optimizer.weight_decay": AMOUNT,
    "refine": integer(least=0),
    "refine_cameras": integer(least=0),
    "refine_masks": integer(least=0),
    "renderer.alpha_max": SHARE,
    "renderer.antialiased": FLAG | NULL,
    "renderer.backend": TEXT,
    "renderer.background": number() | list_of(number()),
    "renderer.far": POSITIVE,
    "renderer.low_pass": AMOUNT | NULL,
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
    "feature_cache.of": TEXT,
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
