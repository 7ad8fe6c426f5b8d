"""The keys of a verb: its YAML and its options say the same, and wrong values are named."""

import pytest

from ghgs_lit.config import run_of
from ghgs_lit.config.options import meanings, options_of
from ghgs_lit.config.registry import KINDS, verb_class, verbs
from ghgs_lit.errors import InputError

#: What the user must say.
GIVEN = {"export": ["checkpoint=a.ckpt"], "import": ["out=b.ckpt"], "table": ["runs=c"]}


def every_class(cls):
    yield cls
    for field in cls.model_fields.values():
        if (nested := options_of(field.annotation)) is not None:
            yield from every_class(nested)


@pytest.mark.parametrize("verb", verbs())
def test_yaml_and_options_of_a_verb_agree(verb):
    """A default in two places that differ would be wrong in one of them."""
    read = run_of(verb, GIVEN.get(verb, []))
    options = verb_class(verb)
    own = {name for name in read.plain if name not in KINDS}
    assert own == set(options.model_fields)
    for name, field in options.model_fields.items():
        if name not in {text.split("=")[0] for text in GIVEN.get(verb, [])}:
            assert getattr(read, name) == field.get_default(call_default_factory=True), name


def test_every_key_of_a_verb_has_a_meaning():
    """``--help`` shows it."""
    for cls in (cls for verb in verbs() for cls in every_class(verb_class(verb))):
        assert set(cls.model_fields) <= set(meanings(cls)), cls


@pytest.mark.parametrize(
    ("verb", "override", "message"),
    [
        ("train", f"seed={10**400}", "seed: expected an integer >= 0 and <= 4294967295; found 1000"),
        ("train", "+sed=3", "sed: expected one of allow_random_encoder"),
        ("predict", "refine=1e9", "refine: expected an integer >= 0 and <= 10000; found 1000000000.0"),
        ("table", "runs=[]", "runs: expected a path or a list of paths; found []"),
    ],
)
def test_a_wrong_value_is_named(verb, override, message):
    overrides = [text for text in GIVEN.get(verb, []) if text.split("=")[0] != override.split("=")[0]]
    with pytest.raises(InputError) as caught:
        run_of(verb, [*overrides, override])
    assert message in str(caught.value)
