"""YAML files and options agree: no key without a field, no field that no shipped file sets."""

import re
from pathlib import Path

import pytest
import yaml
from omegaconf import OmegaConf

from ghgs_lit.config import run_of
from ghgs_lit.config.options import describe_field, meaning_of, options_of
from ghgs_lit.config.registry import KINDS, NAMED, class_of, read_nodes, verb_class, verbs
from ghgs_lit.errors import InputError
from tests.helpers.configs import composed, verb_with

TYPED = [(group, kind) for group, kinds in KINDS.items() for kind in kinds]


def nested_classes(cls):
    yield cls
    for field in cls.model_fields.values():
        if (nested := options_of(field.annotation)) is not None:
            yield from nested_classes(nested)


def test_every_field_has_a_meaning():
    """Printed by ``ghgs <verb> --help`` and ``ghgs <verb> --help <group>``."""
    for cls in [class_of(group, kind, group) for group, kind in TYPED] + [
        verb_class(verb) for verb in verbs()
    ]:
        for each in nested_classes(cls):
            assert all(meaning_of(each, name) for name in each.model_fields), each


#: Required keys.
GIVEN = {"export": ["checkpoint=a.ckpt", "inference=b.ckpt"], "import": ["out=b.ckpt"], "table": ["runs=c"]}


@pytest.mark.parametrize("verb", verbs())
def test_yaml_and_options_of_a_verb_agree(verb):
    """A default that differs in two places would be wrong in one of them."""
    given = GIVEN.get(verb, [])
    read = run_of(verb, given)
    options = verb_class(verb)
    assert {name for name in read.plain if name not in KINDS} == set(options.model_fields)
    for name, field in options.model_fields.items():
        if name not in {text.split("=")[0] for text in given}:
            assert getattr(read, name) == field.get_default(call_default_factory=True), name


#: Integers that need no limit, by reason: no value hangs or exhausts memory.
UNLIMITED = {
    "there are no more": """
        subjects subject pictures k tolerance chamfer_points limit_val_batches
        start stop step split frames cameras""",
    "refused where there are fewer": """
        evaluation_positions positions views evaluation_count training_counts per_subject per_step layers
        token sequences""",
    "how seldom something comes": """
        every every_n_train_steps log_every_n_steps val_check_interval exact_from""",
    "the end of a run or epoch comes first, or Ctrl-C": """
        max_steps steps_per_epoch accumulate_grad_batches skip_nonfinite""",
    "of a list": "devices",
}


def numbers(cls, prefix=""):
    """Keys of a class's fields with an integer that has no upper limit."""
    for name, field in cls.model_fields.items():
        if (nested := options_of(field.annotation)) is not None:
            yield from numbers(nested, f"{prefix}{name}.")
        elif re.search(r"an integer( >=? -?\d+)?( or|\)|$)", describe_field(cls, name)):
            yield f"{prefix}{name}"


def test_every_number_has_a_limit_or_can_do_no_harm():
    """Regression: ``skip.margin=1000000000`` and ``rounds.count=1000000000`` ran until they were killed."""
    classes = [class_of(group, kind, group) for group, kind in TYPED] + [verb_class(verb) for verb in verbs()]
    found = {key for cls in classes for key in numbers(cls)}
    harmless = {name for names in UNLIMITED.values() for name in names.split()}
    assert {key for key in found if key not in harmless and key.split(".")[-1] not in harmless} == set()
    assert "k" in found


@pytest.fixture(scope="module")
def whole():
    """A configuration with every group."""
    cfg = composed("train", "model=recurrent")
    return OmegaConf.to_container(cfg, resolve=True)


def with_value(config, key, value):
    """``config`` with another value at a dotted key; nodes along the path are copied."""
    name, _, rest = key.partition(".")
    return {**config, name: with_value(config[name], rest, value) if rest else value}


def message(verb, config):
    """Error message for a configuration; None if it is valid."""
    try:
        verb_class(verb).of(config)
    except InputError as error:
        return str(error)


def test_wrong_values_are_named_with_what_was_expected_and_found():
    """Regression: wrong types and ranges ended in tracebacks, comparisons of texts with numbers, or
    endless runs."""
    wrong = []
    for line in Path(__file__).with_name("wrong_values.txt").read_text().splitlines():
        command, _, words = line.partition(": ")
        verb, *others, setting = command.split()
        key, _, text = setting.partition("=")
        config = OmegaConf.to_container(composed(verb, *others), resolve=True)
        value = text if ":" in text else yaml.safe_load(text)
        said = message(verb, with_value(config, key, value)) or "nothing"
        if not (
            said.startswith(f"{key}: expected ") and words in said and said.endswith(f"; found {value!r}")
        ):
            wrong.append(f"{line}\n    {said}")
    assert not wrong, "\n".join(wrong)


def test_what_the_documentation_allows_passes(whole):
    """Options must not reject values that work."""
    for key, value in (
        ("optimizer.lr", 1),
        ("trainer.max_time", {"hours": 2}),
        ("trainer.max_time", None),
        ("trainer.devices", [0, 1]),
        ("callbacks.best.filename", "best-{step:06d}-{val/psnr:.2f}"),
        ("targets.per_subject", "all"),
        ("data.evaluation_positions", [[0, 6, 11]]),
        ("optimizer.freeze_until", {"depth_head.dpt": 0.5}),
        ("callbacks", {}),
        ("data.size", [360, 640]),
    ):
        read_nodes(with_value(whole, key, value))


def test_an_unknown_key_is_refused_in_every_group(whole):
    """A misspelt key that is ignored would be a setting without effect."""
    for group in KINDS:
        verb = verb_with(group)
        config = whole if verb == "train" else OmegaConf.to_container(composed(verb), resolve=True)
        key = f"{group}.{next(iter(config[group]))}" if group in NAMED else group
        with pytest.raises(InputError, match=rf"{key}.nonsense: expected .*; found 'nonsense'"):
            read_nodes(with_value(config, f"{key}.nonsense", 1))
