"""``ghgs --help`` and ``ghgs <verb> --help [group]``: print keys with meaning, default and range, read
from the options classes."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from ghgs_lit.config.compose import compose
from ghgs_lit.config.options import describe_field, did_you_mean, meaning_of, options_of
from ghgs_lit.config.reading import conf_dir
from ghgs_lit.config.registry import KINDS, NAMED, class_of, kinds_of, verb_class, verbs
from ghgs_lit.errors import InputError


def usage() -> str:
    """Text of ``ghgs --help``: every verb with its summary and an example, verbs of plug-ins last."""
    lines = ["usage: ghgs <verb> [key=value ...] [group=option ...] [-m]", ""]
    for name in verbs():
        about = verb_class(name)
        lines.append(f"  {name:10} {about.summary()}\n             {about.example}")
    lines += [
        "",
        "ghgs <verb> --help lists the groups and keys of a verb; ghgs --version prints the version.",
    ]
    return "\n".join(lines)


def print_help(verb: str, groups: Sequence[str], overrides: Sequence[str], folder: str | None) -> None:
    """Print the keys of some groups, or the files of groups without keys; without groups the summary,
    groups and keys of a verb.

    Args:
        verb: Name of a verb.
        groups: Names of groups; empty: help of the verb.
        overrides: Overrides of the command line, whose values are printed as defaults.
        folder: Value of ``--config-dir``, if any.

    Raises:
        InputError: The verb has no such group.
    """
    cfg = compose(verb, overrides, with_hydra=True, folder=folder, is_filled=bool(groups))
    choices = reversed(cfg.hydra.runtime.choices.items())
    chosen = {group: name for group, name in choices if not group.startswith("hydra/")}
    known = list(dict.fromkeys([*chosen, *(name for name in cfg if name in KINDS), "rounds"]))
    places = [conf_dir(), *([Path(folder)] if folder is not None else [])]
    for group in groups:
        if group not in known:
            expected = f"a group of ghgs {verb}, one of {', '.join(known)}"
            raise InputError(f"--help: expected {expected}; found {group!r}{did_you_mean(group, known)}")
        node = OmegaConf.select(cfg, group.replace("/", ".")) or {}
        values = {part.get("kind"): part for part in (node.values() if group in NAMED else [node])}
        for kind in kinds_of(group):
            print(f"== {group}" + f": {{kind: {kind}, ...}}" * bool(kind) + " ==")
            _print_fields(class_of(group, kind, group), values.get(kind, {}))
        if not kinds_of(group):  # its options are files that set keys of other groups
            for path in sorted(path for place in places for path in (place / group).glob("*.yaml")):
                print(f"== {group}={path.stem} ==\n{path.read_text()}")
    if groups:
        return
    about = verb_class(verb)
    print(f"ghgs {verb} [key=value ...] [group=option ...] [-m for a sweep over comma-separated values]\n")
    print(f"{about.summary()}: {about.example}\n\n== Groups (group=option; * is chosen) ==")
    for group, name in chosen.items():
        options = sorted(path.stem for place in places for path in (place / group).glob("*.yaml"))
        print(f"{group}: {' | '.join(f'{option}*' if option == name else option for option in options)}")
    print(f"\nghgs {verb} --help <group> explains the keys of a group.\n\n== Keys (key=value) ==")
    _print_fields(about, cfg)
    print("\n--cfg job prints the composed configuration, --info defaults its files.")


def _print_fields(cls: type[BaseModel], values: Mapping[str, Any], indent: str = "") -> None:
    """Print the fields of a class, with the composed values as defaults."""
    for name, field in cls.model_fields.items():
        nested = options_of(field.annotation)
        default = values.get(name, field.get_default(call_default_factory=True))
        text = " ".join(meaning_of(cls, name).split())
        if nested is not None:
            print(f"{indent}{name}: {text}")
            _print_fields(nested, default if isinstance(default, Mapping) else {}, indent + "  ")
            continue
        is_missing = default is PydanticUndefined
        shown = "must be given" if is_missing else f"default {json.dumps(default, default=list)}"
        print(f"{indent}{name} ({shown}; {describe_field(cls, name)})\n{indent}    {text}")
