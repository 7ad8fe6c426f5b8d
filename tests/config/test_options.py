"""YAML and options say the same: no key without a field, no field that no shipped file sets."""

from typing import get_origin

import pytest
from omegaconf import OmegaConf

from ghgs_lit.cli.main import VERBS
from ghgs_lit.config import compose, conf_dir
from ghgs_lit.config.describe import meanings, options_of
from ghgs_lit.config.keys import flatten
from ghgs_lit.config.options import Options
from ghgs_lit.config.registry import KINDS, NAMED, class_of
from tests.helpers.configs import composed

TYPED = [
    (group, kind)
    for group, kinds in KINDS.items()
    for kind in kinds
    if issubclass(class_of(group, kind, group), Options)
]


def shipped(group):
    """The nodes of a group in everything that ships, as plain data."""
    files = sorted((conf_dir() / group).glob("*.yaml"))
    configurations = [composed("train", f"{group}={path.stem}") for path in files]
    configurations += [composed("train", f"model={name}") for name in ("paper", "hull", "recurrent")]
    configurations += [composed("train", *over) for over in (["compat=release"], ["experiment=shipped"])]
    configurations += [compose(verb) for verb in VERBS]
    for cfg in configurations:
        node = OmegaConf.to_container(cfg, resolve=False).get(group)
        if node:
            yield from node.values() if group in NAMED else [node]


def fields(cls, prefix=""):
    for name, field in cls.model_fields.items():
        # Of lists of options files have whole values.
        nested = None if get_origin(field.annotation) is tuple else options_of(field.annotation)
        yield f"{prefix}{name}"
        if nested is not None:
            yield from fields(nested, f"{prefix}{name}.")


@pytest.mark.parametrize(("group", "kind"), TYPED, ids=[f"{g}={k}" for g, k in TYPED])
def test_every_field_is_set_by_a_shipped_file(group, kind):
    """A field that no file sets is a constant, or a key that nobody finds."""
    nodes = [node for node in shipped(group) if kind is None or node.get("kind") == kind]
    keys = {key for node in nodes for key in flatten(node)}
    keys |= {key.rsplit(".", 1)[0] for key in keys if "." in key}
    missing = [name for name in fields(class_of(group, kind, group)) if name not in keys]
    assert missing == []


@pytest.mark.parametrize(("group", "kind"), TYPED, ids=[f"{g}={k}" for g, k in TYPED])
def test_every_field_has_a_meaning(group, kind):
    """``ghgs <verb> --help <group>`` shows it."""

    def check(cls):
        assert sorted(set(cls.model_fields) - set(meanings(cls))) == []
        for field in cls.model_fields.values():
            if (nested := options_of(field.annotation)) is not None:
                check(nested)

    check(class_of(group, kind, group))
