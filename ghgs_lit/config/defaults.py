"""Defaults of options, which YAML does not repeat.

A key that no file sets has the default of its class. Hydra refuses overrides of keys that are not
there, so nodes of options are opened when their file is read. Classes are imported later, because
libraries come with them: then unknown keys are refused and defaults are filled in. Those of verbs,
which need no library, are filled in at once.
"""

from collections.abc import Mapping
from typing import Any, get_origin

from omegaconf import MISSING, DictConfig, OmegaConf, flag_override
from pydantic import BaseModel

from ghgs_lit.config.options import options_of
from ghgs_lit.config.registry import class_of_node, has_kind, nodes_of, verb_class


def with_defaults(values: Mapping[str, Any], cls: type[BaseModel]) -> dict[str, Any]:
    """Values of options, completed by the defaults of their class.

    Args:
        values: plain data by key, unchecked; unknown keys stay, for a check to refuse.
        cls: the class of the options. Fields without a default are not filled in.

    Returns:
        Plain data, keys of the class first and in its order.
    """
    full: dict[str, Any] = {}
    for name, field in cls.model_fields.items():
        default = MISSING if field.is_required() else _plain(field.get_default(call_default_factory=True))
        value = values.get(name, default)
        nested = None if get_origin(field.annotation) in (tuple, dict) else options_of(field.annotation)
        if nested is not None and isinstance(value, Mapping):
            value = with_defaults(_over(default, value), nested)
        full[name] = value
    kept = {name: value for name, value in full.items() if name in values or value != MISSING}
    return kept | {name: value for name, value in values.items() if name not in full}


def _over(default: Any, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values over those that a default has set, if it is a mapping, too."""
    if not isinstance(default, Mapping):
        return dict(values)
    merged = dict(default)
    for name, value in values.items():
        merged[name] = _over(default.get(name), value) if isinstance(value, Mapping) else value
    return merged


def _plain(value: Any) -> Any:
    """A default as plain data; of options the fields that were set."""
    if isinstance(value, BaseModel):
        return {name: _plain(getattr(value, name)) for name in value.model_fields_set}
    return list(map(_plain, value)) if isinstance(value, tuple) else value


def of_verb(name: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """The configuration of a verb with all of its keys; those that must be given are ``???``.

    Args:
        name: of the verb.
        values: content of its file, groups included.
    """
    cls = verb_class(name)
    must = {key: MISSING for key, field in cls.model_fields.items() if field.is_required()}
    return with_defaults(must | dict(values), cls)


def fill(cfg: DictConfig) -> DictConfig:
    """Fill in the defaults of all nodes of options.

    Args:
        cfg: a composed configuration, which is changed; interpolations stay.

    Returns:
        ``cfg``.

    Raises:
        InputError: a node names an unknown kind.
    """
    for key, node in list(nodes_of(cfg)):
        if OmegaConf.is_dict(node) and has_kind(key, node):
            values = OmegaConf.to_container(node)
            full = with_defaults(values, class_of_node(node, key))
            with flag_override(cfg, ["readonly", "struct"], False):
                OmegaConf.update(cfg, key, {k: full[k] for k in ("kind",) if k in full} | full, merge=False)
    return cfg


def open_nodes(path: str, package: str, content: DictConfig) -> None:
    """Let Hydra override keys of options that their file does not set.

    Args:
        path: of the file below the folder of configurations, such as ``bounds/box``.
        package: value of its line ``@package``; empty: its group.
        content: the file's, which gets the flag.
    """
    group = path.split("/")[0]
    root = content if group == path or package == "_global_" else {group: content}
    for key, node in nodes_of(root):
        if OmegaConf.is_dict(node) and has_kind(key, node):
            OmegaConf.set_struct(node, False)
