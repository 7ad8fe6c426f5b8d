"""What a configuration may build: kinds of options by group, never a path of Python code.

A configuration can come from somebody else's checkpoint. A node such as ``depth_head: {kind: dpt, ...}``
names one of the kinds below or one that the user's own code has registered; code is imported from
``GHGS_PLUGINS`` alone (:mod:`ghgs_lit.config.plugins`).
"""

import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

from omegaconf import OmegaConf

from ghgs_lit.config.describe import options_of
from ghgs_lit.config.options import Options, did_you_mean
from ghgs_lit.config.plugins import VARIABLE, load_plugins
from ghgs_lit.errors import InputError

_C = TypeVar("_C", bound=type[Options])

#: Options by group and kind; the kind None is that of groups whose nodes have no key ``kind``.
KINDS: dict[str, dict[str | None, str]] = {
    "bounds": {
        "box": "ghgs_lit.bounds.SubjectBox",
        "hull": "ghgs_lit.bounds.VisualHull",
        "none": "ghgs_lit.bounds.NoBounds",
    },
    "encoder": {"vggt": "ghgs_lit.encoder.VGGTEncoder"},
    "depth_head": {"dpt": "ghgs_lit.heads.depth.DepthHead"},
    "unprojection": {"pinhole": "ghgs_lit.geometry.unprojection.Unprojection"},
    "recalibration": {"semantic": "ghgs_lit.recalibration.Recalibration"},
    "gaussian_head": {"dpt": "ghgs_lit.heads.gaussian.GaussianHead"},
    "rounds": {"recurrent": "ghgs_lit.rounds.Rounds"},
    "renderer": {"splats": "ghgs_lit.rendering.Renderer"},
    "loss": {"weighted": "ghgs_lit.losses.Losses"},
    "metrics": {"images": "ghgs_lit.metrics.MetricsOptions"},
    "optimizer": {"adamw": "ghgs_lit.training.Optimization"},
    "trainer": {"lightning": "ghgs_lit.training.trainer.TrainerOptions"},
    "data": {
        "humman": "ghgs_lit.data.datamodules.HuMManDataModule",
        "rendered": "ghgs_lit.data.datamodules.RenderedDataModule",
        "scans": "ghgs_lit.synthesis.datamodules.ScansDataModule",
        "synthetic": "ghgs_lit.synthesis.datamodules.SyntheticDataModule",
        "thuman2": "ghgs_lit.synthesis.datamodules.THuman2DataModule",
        "zju_mocap": "ghgs_lit.data.datamodules.ZJUMoCapDataModule",
    },
    "callbacks": {
        "attention": "ghgs_lit.training.validation_pictures.AttentionOptions",
        "checkpoints": "ghgs_lit.training.checkpoints.CheckpointOptions",
        "memory": "ghgs_lit.training.callbacks.MemoryOptions",
        "pictures": "ghgs_lit.training.validation_pictures.PicturesOptions",
        "point_clouds": "ghgs_lit.training.validation_pictures.PointCloudOptions",
        "progress": "ghgs_lit.training.callbacks.ProgressOptions",
        "step_time": "ghgs_lit.training.callbacks.StepTimeOptions",
    },
    "logger": {
        "csv": "ghgs_lit.training.loggers.CsvOptions",
        "tensorboard": "ghgs_lit.training.loggers.TensorBoardOptions",
        "wandb": "ghgs_lit.training.loggers.WandbOptions",
    },
}

#: Groups whose nodes have names: ``callbacks.<name>: {kind: ...}``.
NAMED = ("callbacks", "logger")

#: Kinds of the user's own code.
_REGISTERED: dict[tuple[str, str], type[Options]] = {}


def register(group: str, kind: str) -> Callable[[_C], _C]:
    """Class decorator: configurations may say ``<group>: {kind: <kind>, ...}`` for these options.

    Args:
        group: a key of :data:`KINDS`.
        kind: a name that no kind of the group has.

    Raises:
        InputError: there is no such group, or the kind is taken.
    """
    if group not in KINDS:
        raise InputError(f"register: expected one of {', '.join(KINDS)}; found {group!r}")

    def keep(cls: _C) -> _C:
        other = _REGISTERED.get((group, kind))
        taken = kind in KINDS[group] or (other is not None and other.__qualname__ != cls.__qualname__)
        if taken:
            raise InputError(f"register: expected a new kind of {group}; found {kind!r}")
        _REGISTERED[group, kind] = cls
        return cls

    return keep


def class_of(group: str, kind: Any, key: str) -> type[Options]:
    """The options of a kind.

    Args:
        group: a key of :data:`KINDS`.
        kind: a kind of the group, None where its nodes have none.
        key: dotted key of the node, for messages.

    Raises:
        InputError: there is no such kind; names those that there are.
    """
    known = KINDS[group]
    if isinstance(kind, str) and kind not in known:
        load_plugins()
        if (group, kind) in _REGISTERED:
            return _REGISTERED[group, kind]
    if not (kind is None or isinstance(kind, str)) or kind not in known:
        names = sorted(name for name in known if name) + [k for g, k in _REGISTERED if g == group]
        expected = "one of " * (len(names) > 1) + ", ".join(names)
        raise InputError(
            f"{key}.kind: expected {expected}; found {kind!r}{did_you_mean(kind, names)}"
            f" ({VARIABLE}=file.py adds kinds of your own)"
        )
    module, _, name = known[kind].rpartition(".")
    return getattr(importlib.import_module(module), name)


def read_node(node: Any, key: str) -> Options:
    """The checked options of a node.

    Args:
        node: a mapping of plain data, with ``kind`` where its group has kinds.
        key: its dotted key in the configuration, such as ``bounds`` or ``callbacks.best``.

    Raises:
        InputError: names the key of the first wrong value, what was expected and what was found.
    """
    group = key.split(".")[0]
    if not isinstance(node, Mapping):
        raise InputError(f"{key}: expected a mapping of its keys; found {node!r}")
    values = OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else dict(node)
    kind = None if None in KINDS[group] else values.pop("kind", None)
    cls = class_of(group, kind, key)
    return cls.read(values, key) if issubclass(cls, Options) else _Arguments(cls, values, key)


def build(node: Any, key: str, **extra: Any) -> Any:
    """The object that a node describes.

    Args:
        node, key: as for :func:`read_node`.
        extra: what the options need beside themselves.

    Raises:
        InputError: as :func:`read_node`; other errors keep their type.
    """
    return read_node(node, key).build(**extra)


def option_keys() -> list[str]:
    """The dotted keys of all options of this package, but for those of groups whose nodes have names."""
    kinds = [(group, class_of(group, kind, group)) for group in KINDS for kind in KINDS[group]]
    return [
        key
        for group, cls in kinds
        if group not in NAMED and issubclass(cls, Options)
        for key in _keys_below(cls, group)
    ]


def _keys_below(cls: type[Options], parent: str) -> Iterator[str]:
    for name, field in cls.model_fields.items():
        yield f"{parent}.{name}"
        nested = options_of(field.annotation)
        if nested is not None:
            yield from _keys_below(nested, f"{parent}.{name}")


class _Arguments:
    """Options of a class that takes them one by one."""

    def __init__(self, cls: type, values: Mapping[str, Any], key: str) -> None:
        self._cls, self._values, self._key = cls, values, key

    def build(self, **extra: Any) -> Any:
        known = inspect.signature(self._cls).parameters.values()
        names = [parameter.name for parameter in known]
        for name in self._values:
            takes_all = any(parameter.kind == parameter.VAR_KEYWORD for parameter in known)
            if name not in names and (name.startswith("_") or not takes_all):
                raise InputError(f"{self._key} key: expected one of {', '.join(names)}; found {name!r}")
        return self._cls(**{**self._values, **extra})


def is_typed(key: str, node: Any) -> bool:
    """Whether the value of a dotted key is a node of typed options, which are then checked."""
    group, *names = key.split(".")
    if group not in KINDS or len(names) != (group in NAMED) or not isinstance(node, Mapping):
        return False
    if None not in KINDS[group] and "kind" not in node:
        return False
    return isinstance(read_node(node, key), Options)
