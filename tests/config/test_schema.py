"""Every key of every configuration has a type and a range, and messages name all three parts."""

import functools
import math

import pytest
from omegaconf import OmegaConf

from ghgs_lit.cli.main import VERBS
from ghgs_lit.config import compose, conf_dir, registry, resolve
from ghgs_lit.config.keys import flatten
from ghgs_lit.config.options import Options
from ghgs_lit.config.registry import class_of
from ghgs_lit.config.schema import KINDS, check, is_node, kind_of
from ghgs_lit.errors import InputError
from tests.helpers.configs import composed

GROUPS = sorted(path.name for path in conf_dir().iterdir() if path.is_dir() and path.name != "hydra")
OPTIONS = [(g, path.stem) for g in GROUPS for path in sorted((conf_dir() / g).glob("*.yaml"))]


def nested(key, value):
    """A configuration of one dotted key."""
    for name in reversed(key.split(".")):
        value = {name: value}
    return value


@functools.cache
def leaves(verb, *overrides):
    """The values of a composed configuration by dotted key; what the user must give is left out."""
    plain = OmegaConf.to_container(composed(verb, *overrides), resolve=True)
    return {key: value for key, value in flatten(plain).items() if value != "???"}


def has_options(key):
    """Whether a dotted key belongs to typed options (tests/config/test_options.py)."""
    kinds = registry.KINDS.get(key.split(".")[0])
    return kinds is not None and all(
        issubclass(class_of(key.split(".")[0], kind, key), Options) for kind in kinds
    )


def assert_typed(found):
    found = {key: value for key, value in found.items() if not has_options(key)}
    assert {key for key in found if kind_of(key) is None and not is_node(key)} == set()
    for key, value in found.items():
        check(nested(key, value))


@pytest.mark.parametrize("verb", sorted(VERBS))
def test_every_key_of_a_verb_has_a_type_that_its_own_value_fulfils(verb):
    """A new key without an entry in the table would be unchecked."""
    assert_typed(leaves(verb))


@pytest.mark.parametrize(("group", "name"), OPTIONS, ids=[f"{g}={n}" for g, n in OPTIONS])
def test_every_key_of_an_option_has_a_type_that_its_own_value_fulfils(group, name):
    """The same for keys that only some options of a group have."""
    assert_typed(leaves("train", f"{group}={name}"))


def test_the_table_has_no_entry_without_a_key():
    """An entry of a key that was renamed or removed would be dead, and its new name unchecked."""
    found = {key for verb in VERBS for key in leaves(verb)}
    for group, name in OPTIONS:
        found |= set(leaves("train", f"{group}={name}"))
    # What the user must give, and what may be null or a mapping in place of the shipped value.
    found |= {"checkpoint", "out", "runs", "trainer.max_time.hours"}
    matched = {id(kind_of(key)) for key in found}
    unused = [key for key in KINDS if key not in found and id(KINDS[key]) not in matched]
    assert unused == []


@pytest.mark.parametrize(
    ("key", "value", "expected"),
    [
        ("optimizer.lr", "abc", "a number > 0"),
        ("optimizer.lr", 0.0, "a number > 0"),
        ("optimizer.lr", math.nan, "a number > 0"),
        ("optimizer.lr", math.inf, "a number > 0"),
        ("optimizer.lr", True, "a number > 0"),
        ("optimizer.lr", {"high": 1}, "a number > 0"),
        ("optimizer.betas", [0.9], "a list of 2 values"),
        ("optimizer.betas", [0.9, 1.0], "each a number >= 0 and < 1"),
        ("seed", True, "an integer >= 0"),
        ("seed", 10**400, "<= 4294967295"),
        ("seed", -1, "an integer >= 0"),
        ("seed", None, "an integer"),
        ("trainer.max_steps", 1.5, "an integer >= -1"),
        ("trainer.max_steps", "abc", "an integer >= -1"),
        ("trainer.val_check_interval", 0, "an integer >= 1 or a number > 0 and <= 1"),
        ("trainer.max_time", 10, "days:hours:minutes:seconds such as 00:00:10:00 or null"),
        ("trainer.devices", True, "an integer >= 1"),
        ("encoder.patch_size", 0, "an integer >= 1"),
        ("bounds", "box", "a mapping of its keys"),
    ],
)
def test_a_wrong_value_is_named_with_what_was_expected_and_found(key, value, expected):
    """Wrong types and ranges ended in tracebacks, comparisons of texts with numbers, or ran for ever."""
    with pytest.raises(InputError) as caught:
        check(nested(key, value))
    message = str(caught.value)
    assert message.startswith(f"{key}: expected ")
    assert expected in message
    assert message.endswith(f"; found {value!r}")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("optimizer.lr", 1),
        ("trainer.max_time", {"hours": 2}),
        ("trainer.max_time", None),
        ("trainer.val_check_interval", 0.5),
        ("trainer.devices", [0, 1]),
        ("optimizer.freeze_until", {"depth_head.dpt": 0.5}),
        ("callbacks", {}),
        ("an.unknown.key", object()),
    ],
)
def test_what_the_documentation_allows_passes(key, value):
    """The table must not forbid values that work."""
    check(nested(key, value))


def test_resolve_checks():
    """Verbs, sweeps and saved configurations all go through ``resolve``."""
    with pytest.raises(InputError, match=r"data\.batch_size: expected an integer >= 1; found 1\.5"):
        resolve(compose("train", ["data.batch_size=1.5"]))
