"""Registry of the kinds of options that a configuration may build, by group, and of verbs.

A configuration can come from an untrusted checkpoint, so it never contains an import path: a node such as
``depth_head: {kind: dpt, ...}`` can only name a kind listed below or a registered one. Plug-ins register
kinds and verbs: modules in the environment variable ``GHGS_PLUGINS`` (Python files or module names,
separated as in ``PATH``) or entry points in the group ``ghgs_lit.plugins``. The other packages of this
distribution, ``ghgs_people`` and ``ghgs_capture``, are such entry points; they register import paths, so
that nothing is imported before it is chosen.
"""

import gc
import importlib
import importlib.metadata
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf

from ghgs_lit.config.options import Options, did_you_mean
from ghgs_lit.errors import InputError, format_value, require

VARIABLE = "GHGS_PLUGINS"
GROUP = "ghgs_lit.plugins"
#: Registered groups that are not configuration groups: verbs, body models with known parts, and terms of the
#: loss, which are keys of ``loss.weights``.
VERB = "verb"
PARTS = "parts"
TERM = "term"


def load_plugins() -> None:
    """Import the user's plug-ins, which register their kinds.

    Errors raised inside a module keep their type.

    Raises:
        InputError: A file is missing, has a dot in its name, or another module has its name.
    """
    # Files opened while the collector is disabled would be frozen, and not flushed at exit.
    gc.enable()
    for entry in os.environ.get(VARIABLE, "").split(os.pathsep):
        if entry.strip().endswith(".py"):
            _import_file(Path(os.path.realpath(os.path.expanduser(entry.strip()))))
        elif entry.strip():
            importlib.import_module(entry.strip())
    for name in _installed_plugins():
        importlib.import_module(name)


@cache
def _installed_plugins() -> tuple[str, ...]:
    return tuple(point.value for point in importlib.metadata.entry_points(group=GROUP))


def _import_file(path: Path) -> None:
    """Import a Python file by its name, after adding its folder to the import path."""
    fits = path.is_file() and "." not in path.stem
    require(fits, VARIABLE, "a Python file without a dot in its name", str(path))
    if str(path.parent) not in sys.path:
        # Appended, so that the file's neighbours do not shadow installed packages.
        sys.path.append(str(path.parent))
        importlib.invalidate_caches()
    file = importlib.import_module(path.stem).__file__
    fits = file is not None and Path(file).resolve() == path
    require(fits, VARIABLE, f"a name that no other module has for {path}", file)


_C = TypeVar("_C", bound=Callable)

#: Import path of options by group and kind; groups are in the order of saved configurations.
#: Kind None: nodes of the group have no key ``kind``.
KINDS: dict[str, dict[str | None, str]] = {
    "data": {
        "humman": "ghgs_lit.data.humman.HuMMan",
        "zju_mocap": "ghgs_lit.data.zju_mocap.ZJUMoCap",
    },
    "views": {None: "ghgs_lit.data.sampling.ViewProtocol"},
    "targets": {None: "ghgs_lit.data.sampling.TargetProtocol"},
    "augmentation": {None: "ghgs_lit.data.augmentation.Augmentation"},
    "encoder": {"vggt": "ghgs_lit.method.encoder.VGGTOptions"},
    "feature_cache": {
        "none": "ghgs_lit.training.features.NoFeatureCache",
        "disk": "ghgs_lit.training.features.DiskFeatureCache",
    },
    "skip": {None: "ghgs_lit.method.plan.presets.SkipOptions"},
    "metrics": {"images": "ghgs_lit.metrics.MetricsOptions"},
    "renderer": {"splats": "ghgs_lit.rendering.Renderer"},
    "loss": {"weighted": "ghgs_lit.losses.Losses"},
    "optimizer": {"adamw": "ghgs_lit.training.Optimization"},
    "trainer": {"lightning": "ghgs_lit.training.trainer.TrainerOptions"},
    "logger": {
        "csv": "ghgs_lit.training.loggers.CsvOptions",
        "tensorboard": "ghgs_lit.training.loggers.TensorBoardOptions",
    },
    "callbacks": {
        "checkpoints": "ghgs_lit.training.checkpoints.CheckpointOptions",
        "pictures": "ghgs_lit.training.callbacks.PicturesOptions",
        "progress": "ghgs_lit.training.callbacks.ProgressOptions",
    },
    "evaluation": {None: "ghgs_lit.config.nodes.EvaluationOptions"},
    "calibration": {None: "ghgs_lit.config.nodes.Calibration"},
    "bounds": {
        "box": "ghgs_lit.method.bounds.SubjectBox",
        "hull": "ghgs_lit.method.bounds.VisualHull",
        "none": "ghgs_lit.method.bounds.NoBounds",
    },
    "depth_head": {"dpt": "ghgs_lit.method.heads.depth.DepthHeadOptions"},
    "unprojection": {"pinhole": "ghgs_lit.geometry.unprojection.Unprojection"},
    "recalibration": {
        "none": "ghgs_lit.method.recalibration.recalibration.NoRecalibrationOptions",
        "semantic": "ghgs_lit.method.recalibration.RecalibrationOptions",
    },
    "gaussian_head": {"dpt": "ghgs_lit.method.heads.gaussian.GaussianHeadOptions"},
    "model": {None: "ghgs_lit.execution.options.ModelOptions"},
    "rounds": {"recurrent": "ghgs_lit.method.rounds.RoundsOptions"},
    "compat": {None: "ghgs_lit.weights.switches.CompatOptions"},
}

#: Import path of each verb.
VERBS: dict[str, str] = {
    "train": "ghgs_lit.cli.verbs.Train",
    "pretext": "ghgs_lit.cli.verbs.Pretext",
    "evaluate": "ghgs_lit.cli.verbs.Evaluate",
    "table": "ghgs_lit.cli.verbs.Table",
    "benchmark": "ghgs_lit.cli.verbs.Benchmark",
    "stress": "ghgs_lit.cli.verbs.Stress",
    "prepare": "ghgs_lit.cli.verbs.Prepare",
    "import": "ghgs_lit.cli.verbs.Import",
    "export": "ghgs_lit.cli.verbs.Export",
}

#: Import path of each term of the loss, a function or a class.
TERMS: dict[str, str] = {
    "chamfer": "ghgs_lit.losses.terms.chamfer",
    "depth": "ghgs_lit.losses.terms.depth",
    "lpips": "ghgs_lit.losses.terms.Perceptual",
    "render_l1": "ghgs_lit.losses.terms.render_l1",
    "render_ssim": "ghgs_lit.losses.terms.render_ssim",
    "silhouette": "ghgs_lit.losses.terms.silhouette",
}

#: Groups of named nodes, such as ``callbacks.<name>: {kind: ...}``.
NAMED = ("callbacks", "logger")

#: Classes or import paths by group and kind; plug-ins add theirs.
_REGISTERED: dict[tuple[str, str | None], type[Options] | str] = {
    (group, kind): path
    for group, kinds in {**KINDS, VERB: VERBS, TERM: TERMS}.items()
    for kind, path in kinds.items()
}


def register(group: str, kind: str) -> Callable[[_C], _C]:
    """Decorator that registers options as ``<group>: {kind: <kind>, ...}``; with the group ``term``, a
    function or class as the loss term weighted by ``loss.weights.<kind>``; with the group ``verb``, a
    :class:`ghgs_lit.cli.verb.Verb` as ``ghgs <kind>``, which without a file ``<kind>.yaml`` in
    ``--config-dir`` has its keys and no groups.

    Args:
        group: One of :data:`KINDS`, :data:`TERM`, :data:`VERB` or :data:`PARTS`.
        kind: A new kind of the group.

    Raises:
        InputError: The group does not exist, or the kind is taken.
    """

    def keep(cls: _C) -> _C:
        _keep(group, kind, cls)
        return cls

    return keep


def offer(group: str, **paths: str) -> None:
    """Register options by import path; they are imported when chosen.

    Args:
        group: See :func:`register`.
        **paths: Import path by kind, such as ``scans="my_package.scans.Scans"``.

    Raises:
        InputError: The group does not exist, or a kind is taken.
    """
    for kind, path in paths.items():
        _keep(group, kind, path)


def _keep(group: str, kind: str, what: type[Options] | str) -> None:
    if group not in (*KINDS, TERM, VERB, PARTS):
        raise InputError(f"register: expected one of {', '.join([*KINDS, TERM, VERB])}; found {group!r}")
    before = _REGISTERED.setdefault((group, kind), what)
    if _path_of(before) != _path_of(what):
        raise InputError(f"register: expected a new kind of {group}; found {kind!r}")


def _path_of(what: type[Options] | str) -> str:
    """Import path without the module: a file that is loaded twice may have two module names."""
    return what if isinstance(what, str) else what.__qualname__


def import_object(path: str) -> Any:
    """Import the object at a path such as ``my_package.scans.Scans``."""
    module, _, name = path.rpartition(".")
    return getattr(importlib.import_module(module), name)


def _find(group: str, kind: str | None) -> type[Options] | None:
    """Class of a kind; None if it does not exist."""
    if (group, kind) not in _REGISTERED:
        load_plugins()
    what = _REGISTERED.get((group, kind))
    return import_object(what) if isinstance(what, str) else what


def verbs() -> list[str]:
    """Names of all verbs, those of plug-ins last."""
    return kinds_of(VERB)


def verb_class(name: str) -> type[Options]:
    """The class of a verb.

    Args:
        name: one of :func:`verbs`.
    """
    return _find(VERB, name)


def kinds_of(group: str) -> list[str | None]:
    """All kinds of a group, including registered ones; None: the group has no kinds."""
    load_plugins()
    return [kind for of, kind in _REGISTERED if of == group]


def class_of(group: str, kind: Any, key: str) -> type[Options]:
    """Options class of a kind.

    Args:
        group: Name of a group, such as ``bounds``.
        kind: Value in the node, of any type; None: the group has no kinds.
        key: Dotted key of the node, for messages.

    Raises:
        InputError: The kind does not exist; the message lists the known ones.
    """
    cls = _find(group, kind) if kind is None or isinstance(kind, str) else None
    if cls is None:
        names = sorted(name for name in kinds_of(group) if name)
        expected = "one of " * (len(names) > 1) + ", ".join(names)
        raise InputError(
            f"{key}{'.kind' * (group in KINDS)}: expected {expected}; found {format_value(kind)}"
            f"{did_you_mean(kind, names)} ({VARIABLE}=file.py adds kinds of your own)"
        )
    return cls


def class_of_node(node: Mapping[str, Any], key: str) -> type[Options]:
    """Options class of a node.

    Args:
        node: Mapping, with ``kind`` if its group has kinds.
        key: Dotted key of the node.

    Raises:
        InputError: See :func:`class_of`.
    """
    group = key.split(".")[0]
    return class_of(group, None if None in KINDS[group] else node.get("kind"), key)


def read_node(node: Any, key: str) -> Options:
    """Validated options of a node.

    Args:
        node: Mapping of plain data, with ``kind`` if its group has kinds; options are returned as they
            are.
        key: Dotted key of the node, such as ``bounds`` or ``callbacks.best``.

    Raises:
        InputError: The message contains the first wrong key, what was expected and what was found.
    """
    if isinstance(node, Options):
        return node
    if not isinstance(node, Mapping):
        raise InputError(f"{key}: expected a mapping of its keys; found {format_value(node)}")
    values = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else dict(node)
    cls = class_of_node(values, key)
    if None not in KINDS[key.split(".")[0]]:
        values.pop("kind", None)
    return cls.read(values, key)


def build(node: Any, key: str, **extra: Any) -> Any:
    """Build the object that a node describes.

    Args:
        node: See :func:`read_node`.
        key: Dotted key of the node.
        **extra: Further arguments of the ``build`` method of its options.

    Raises:
        InputError: See :func:`read_node`.
    """
    return read_node(node, key).build(**extra)


def nodes_of(config: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Nodes of all groups of a configuration, with their dotted keys.

    Args:
        config: The whole configuration or a part of it. A node is a mapping unless the configuration is
            wrong.
    """
    for group in (name for name in config if name in KINDS):
        node = config[group]
        # Null in verbs that take their data from a checkpoint.
        if node is None and group in ("data", "targets"):
            continue
        if group in NAMED and isinstance(node, Mapping):
            yield from ((f"{group}.{name}", part) for name, part in node.items())
        else:
            yield group, node


def has_kind(key: str, node: Mapping[str, Any]) -> bool:
    """Whether a node describes an object; for example, keys that change the data of a checkpoint have no
    kind.

    Args:
        key: Dotted key of the node.
        node: Value of the node.
    """
    return "kind" in node or None in KINDS[key.split(".")[0]]


def read_nodes(config: Mapping[str, Any]) -> dict[str, Options]:
    """Validated options of the nodes of all groups.

    Args:
        config: The whole configuration as plain data.

    Returns:
        Options by dotted key of the node, without nodes that lack their kind.

    Raises:
        InputError: See :func:`read_node`.
    """
    options = {}
    for key, node in nodes_of(config):
        # Skipped without a kind: an optimizer that the verb lacks, for example.
        if key.split(".")[0] in NAMED or not isinstance(node, Mapping) or has_kind(key, node):
            options[key] = read_node(node, key)
    return options
