"""``ghgs --help`` and ``ghgs <verb> --help [group]``: print keys with meaning, default and range, read
from the options classes."""

import json
import textwrap
from collections.abc import Iterator, Mapping
from itertools import takewhile
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from ghgs_lit.config.folder import conf_dir
from ghgs_lit.config.options import describe_field, did_you_mean, meanings, options_of
from ghgs_lit.config.registry import KINDS, NAMED, class_of, kinds_of, verb_class, verbs
from ghgs_lit.errors import InputError
from ghgs_lit.parsing import read_text


def usage() -> str:
    """Text of ``ghgs --help``: every verb with its summary and an example, verbs of plug-ins last."""
    names = verbs()
    width = max(map(len, names))
    lines = ["usage: ghgs <verb> [key=value ...] [group=option ...] [-m]", ""]
    for name in names:
        summary = verb_class(name).summary()
        lines.append(f"  {name:{width}} {summary[:1].lower()}{summary[1:]}")
        lines.append(f"  {'':{width}}   {verb_class(name).example}")
    end = "ghgs <verb> --help lists the groups and keys of a verb; ghgs --version prints the version."
    return "\n".join([*lines, "", end])


def _groups(cfg: DictConfig, folder: str | None) -> dict[str, dict[str, Path]]:
    """Files of each config group's options by name; the chosen name ends in ``*``.

    ``cfg`` includes the node ``hydra``; ``folder`` is that of ``--config-dir``, if any.
    """
    places = [conf_dir(), *([Path(folder)] if folder is not None else [])]
    groups = {}
    for group, chosen in reversed(cfg.hydra.runtime.choices.items()):
        if "@" in group or group.startswith("hydra/"):
            continue
        paths = [path for place in places for path in sorted((place / group).glob("*.yaml"))]
        groups[group] = {f"{path.stem}{'*' * (path.stem == chosen)}": path for path in paths}
    return groups


def print_verb(verb: str, cfg: DictConfig, folder: str | None = None) -> None:
    """Print the summary of a verb, its groups and its keys.

    Args:
        verb: Name of a verb.
        cfg: Composed configuration, including the node ``hydra``.
        folder: Value of ``--config-dir``, if any.
    """
    print(f"ghgs {verb} [key=value ...] [group=option ...] [-m for a sweep over comma-separated values]\n")
    about = verb_class(verb)
    print(f"{about.summary()}: {about.example}\n")
    print("== Groups (group=option; * is chosen) ==")
    for group, options in _groups(cfg, folder).items():
        print(_wrap(f"{group}: {' | '.join(options)}"))
    print(f"\nghgs {verb} --help <group> explains the keys of a group.\n\n== Keys (key=value) ==")
    print(*_fields(about, cfg), sep="\n")
    print("\n--cfg job prints the composed configuration, --info defaults says where each part comes from.")


def print_group(verb: str, group: str, cfg: DictConfig, folder: str | None = None) -> None:
    """Print the keys of a group with their meaning.

    Args:
        verb: Name of a verb.
        group: Name of the group.
        cfg: Composed configuration, including the node ``hydra``.
        folder: Value of ``--config-dir``, if any.

    Raises:
        InputError: The verb has no such group.
    """
    groups = _groups(cfg, folder)
    known = list(dict.fromkeys([*groups, *(name for name in cfg if name in KINDS), "rounds"]))
    if group not in known:
        hint = did_you_mean(group, known)
        raise InputError(
            f"--help: expected a group of ghgs {verb}, one of {', '.join(known)}; found {group!r}{hint}"
        )
    node = OmegaConf.select(cfg, group.replace("/", ".")) or {}
    values = {part.get("kind"): part for part in (node.values() if group in NAMED else [node])}
    for kind in kinds_of(group):
        print(f"== {group}" + (f": {{kind: {kind}, ...}}" if kind else "") + " ==")
        print(*_fields(class_of(group, kind, group), values.get(kind, {})), "", sep="\n")
    for name, path in groups.get(group, {}).items():
        comment = takewhile(lambda line: line.startswith("#"), read_text(path).splitlines())
        text = " ".join(line.removeprefix("# ") for line in comment if "@package" not in line)
        print(f"{group}={name.replace('*', ' *')}: {text}")


def _fields(cls: type[BaseModel], values: Mapping[str, Any], indent: str = "") -> Iterator[str]:
    """Help lines of the fields of a class, with the composed values as defaults."""
    texts = meanings(cls)
    for name, field in cls.model_fields.items():
        nested = options_of(field.annotation)
        default = values.get(name, field.get_default(call_default_factory=True))
        if nested is not None:
            yield f"{indent}{name}: {' '.join(texts.get(name, '').split())}"
            yield from _fields(nested, default if isinstance(default, Mapping) else {}, indent + "  ")
            continue
        is_missing = default is PydanticUndefined
        shown = "must be given" if is_missing else f"default {json.dumps(default, default=list)}"
        yield f"{indent}{name} ({shown}; {describe_field(field)})"
        if name in texts:
            yield _wrap(" ".join(texts[name].split()), indent + "    ")


def _wrap(text: str, indent: str = "") -> str:
    return textwrap.fill(text, 100, initial_indent=indent, subsequent_indent=indent or "  ")
