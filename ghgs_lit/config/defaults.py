"""Defaults of options, which YAML files do not repeat.

A key that no file sets has the default of its class. Hydra rejects overrides of keys that do not exist,
so option nodes are opened for new keys when their file is read. Their classes are imported later, because
they import large libraries; only then are unknown keys rejected and defaults filled in. Classes of verbs
require no library, so their defaults are filled in at once.
"""

from collections.abc import Mapping
from typing import Any, get_origin

from omegaconf import MISSING, DictConfig, OmegaConf, flag_override
from pydantic import BaseModel

from ghgs_lit.config.options import options_of
from ghgs_lit.config.registry import class_of_node, has_kind, nodes_of, verb_class


def with_defaults(values: Mapping[str, Any], cls: type[BaseModel]) -> dict[str, Any]:
    """Complete the values of options with the defaults of their class.

    Args:
        values: Plain data by key, not validated; unknown keys are kept for validation to reject.
        cls: Class of the options. Fields without a default are not filled in.

    Returns:
        Plain data, keys of the class first and in its order.
    """
    full: dict[str, Any] = {}
    for name, field in cls.model_fields.items():
        default = MISSING if field.is_required() else _to_plain(field.get_default(call_default_factory=True))
        value = values.get(name, default)
        nested = None if get_origin(field.annotation) in (tuple, dict) else options_of(field.annotation)
        if nested is not None and isinstance(value, Mapping):
            value = with_defaults(_merge(default, value), nested)
        full[name] = value
    kept = {name: value for name, value in full.items() if name in values or value != MISSING}
    return kept | {name: value for name, value in values.items() if name not in full}


def _merge(default: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Merge values over those of a default that is a mapping, too."""
    if not isinstance(default, Mapping):
        return dict(values)
    merged = dict(default)
    for name, value in values.items():
        merged[name] = _merge(default.get(name), value) if isinstance(value, Mapping) else value
    return merged


def _to_plain(value: Any) -> Any:
    """Convert a default to plain data; of options, only fields that were set."""
    if isinstance(value, BaseModel):
        return {name: _to_plain(getattr(value, name)) for name in value.model_fields_set}
    return list(map(_to_plain, value)) if isinstance(value, tuple) else value


def verb_values(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Configuration of a verb with all of its keys; required keys without a value are ``???``.

    Args:
        name: Name of the verb.
        values: Content of its file, including groups.
    """
    cls = verb_class(name)
    must = {key: MISSING for key, field in cls.model_fields.items() if field.is_required()}
    return with_defaults(must | dict(values), cls)


def fill(cfg: DictConfig) -> DictConfig:
    """Fill in the defaults of all option nodes.

    Args:
        cfg: Composed configuration, changed in place; interpolations are kept.

    Returns:
        ``cfg``.

    Raises:
        InputError: A node has an unknown kind.
    """
    for key, node in list(nodes_of(cfg)):
        if OmegaConf.is_dict(node) and has_kind(key, node):
            values = OmegaConf.to_container(node)
            full = with_defaults(values, class_of_node(node, key))
            with flag_override(cfg, ["readonly", "struct"], False):
                OmegaConf.update(cfg, key, {k: full[k] for k in ("kind",) if k in full} | full, merge=False)
    return cfg


def open_nodes(path: str, package: str, content: DictConfig) -> None:
    """Allow Hydra to override keys of options that their file does not set.

    Args:
        path: Path of the file relative to the configuration folder, such as ``bounds/box``.
        package: Value of its ``@package`` line; empty: its group.
        content: Content of the file, changed in place.
    """
    group = path.split("/")[0]
    root = content if group == path or package == "_global_" else {group: content}
    for key, node in nodes_of(root):
        if OmegaConf.is_dict(node) and has_kind(key, node):
            OmegaConf.set_struct(node, False)
