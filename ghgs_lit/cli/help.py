"""``ghgs <verb> --help [group]``: keys with meaning, default and range,
read from the options classes."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from ghgs_lit.config import conf_dir
from ghgs_lit.config.options import did_you_mean, expected, meanings, options_of
from ghgs_lit.config.registry import KINDS, NAMED, class_of, kinds_of, verb_class
from ghgs_lit.errors import InputError
from ghgs_lit.parsing import read_text

_WIDTH = 100


def _chosen(cfg: DictConfig) -> dict[str, str | None]:
    """Option of each config group that a command chooses; None where there is none."""
    choices = cfg.hydra.runtime.choices
    groups = [name for name in reversed(list(choices)) if "@" not in name and not name.startswith("hydra/")]
    return {group: choices[group] for group in groups}


def _files(group: str, folders: Sequence[Path]) -> list[Path]:
    """Files of a group's options: those of ``conf``, then those of ``folders``,
    each sorted by name."""
    paths = []
    for folder in (conf_dir(), *folders):
        paths += sorted((folder / group).glob("*.yaml"))
    return paths


def print_verb(verb: str, cfg: DictConfig, folders: Sequence[Path] = ()) -> None:
    """Print what a verb does, its groups and its keys.

    Args:
        verb: name of a verb.
        cfg: what the command composes, with the node ``hydra``.
        folders: those of ``--config-dir``.
    """
    print(f"ghgs {verb} [key=value ...] [group=option ...] [-m for a sweep over comma-separated values]\n")
    about = verb_class(verb)
    print(f"{about.summary()}: {about.example}\n")
    print("== Groups (group=option; * is chosen) ==")
    for group, chosen in _chosen(cfg).items():
        names = [f"{path.stem}{'*' * (path.stem == chosen)}" for path in _files(group, folders)]
        print(_filled(f"{group}: {' | '.join(names)}"))
    print(f"\nghgs {verb} --help <group> explains the keys of a group.\n\n== Keys (key=value) ==")
    for line in _fields(about, cfg):
        print(line)
    print("\n--cfg job prints the composed configuration, --info defaults says where each part comes from.")


def print_group(verb: str, group: str, cfg: DictConfig, folders: Sequence[Path] = ()) -> None:
    """Print the keys of a group with their meaning.

    Args:
        verb: name of a verb.
        group: name of the group.
        cfg: what the command composes, with the node ``hydra``.
        folders: those of ``--config-dir``.

    Raises:
        InputError: the verb has no such group.
    """
    chosen = _chosen(cfg)
    known = [*chosen, *(name for name in cfg if name in KINDS)]
    known = list(dict.fromkeys([*known, *(["rounds"] if "model" in known else [])]))
    if group not in known:
        hint = did_you_mean(group, known)
        raise InputError(
            f"--help: expected a group of ghgs {verb}, one of {', '.join(known)}; found {group!r}{hint}"
        )
    node = OmegaConf.select(cfg, group.replace("/", ".")) or {}
    values = {part.get("kind"): part for part in (node.values() if group in NAMED else [node])}
    for kind in kinds_of(group):
        print(f"== {group}" + (f": {{kind: {kind}, ...}}" if kind else "") + " ==")
        for line in _fields(class_of(group, kind, group), values.get(kind, {})):
            print(line)
        print()
    for path in _files(group, folders):
        print(f"{group}={path.stem}{' *' * (path.stem == chosen.get(group))}: {_purpose(path)}")


def _purpose(path: Path) -> str:
    lines = takewhile(lambda line: line.startswith("#"), read_text(path).splitlines())
    return " ".join(line.removeprefix("# ") for line in lines if "@package" not in line)


def _fields(cls: type[BaseModel], values: Mapping[str, Any], indent: str = "") -> Iterator[str]:
    """Lines for the fields of a class, with the values that the command composes as defaults."""
    texts = meanings(cls)
    for name, field in cls.model_fields.items():
        nested = options_of(field.annotation)
        default = values.get(name, field.get_default(call_default_factory=True))
        if nested is not None:
            yield f"{indent}{name}: {' '.join(texts.get(name, '').split())}"
            yield from _fields(nested, default if isinstance(default, Mapping) else {}, indent + "  ")
            continue
        shown = "must be given" if default is PydanticUndefined else f"default {_yaml(default)}"
        yield f"{indent}{name} ({shown}; {expected(field)})"
        if name in texts:
            yield _filled(" ".join(texts[name].split()), indent + "    ")


def _yaml(value: object) -> str:
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(_yaml, value))}]"
    return str(value)


def _filled(text: str, indent: str = "") -> str:
    return textwrap.fill(text, _WIDTH, initial_indent=indent, subsequent_indent=indent or "  ")
