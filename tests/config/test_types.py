"""Options check types, ranges, unknown and nested keys; texts that spell a number keep their spelling."""

import math
from typing import Literal

import pytest
from pydantic import Field, model_validator

from ghgs_lit.config.nodes import Texts
from ghgs_lit.config.options import Count, Options, PathText, Share, Size, Text, Width, meaning_of
from ghgs_lit.errors import InputError


class Inner(Options):
    features: Width | None = None
    """Channels."""
    channels: tuple[Width, Width] = (1, 2)


class Outer(Options):
    group = "stage"
    start: float = Field(0.5, gt=0, lt=1)
    """Share of the way
    at the start."""
    mode: Literal["a", "b"] = "a"
    inner: Inner = Inner()
    size: Size = 3
    path: PathText | None = None
    per: Count | Literal["all"] = 1
    name: Text = "x"
    shares: dict[str, Share] = Field({})

    @model_validator(mode="after")
    def _b_is_early(self) -> "Outer":
        self.require(self.mode == "a" or self.start < 0.9, "start", "less than 0.9 with mode=b")
        return self


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"start": 2}, "stage.start: expected a number > 0 and < 1; found 2"),
        ({"start": True}, "stage.start: expected a number > 0 and < 1; found True"),
        ({"start": math.nan}, "stage.start: expected a number > 0 and < 1; found nan"),
        ({"start": "0.5"}, "stage.start: expected a number > 0 and < 1; found '0.5'"),
        ({"mode": "c"}, "stage.mode: expected one of a, b; found 'c'"),
        ({"mod": "a"}, "found 'mod' (did you mean mode?)"),
        (
            {"inner": {"features": 0}},
            "stage.inner.features: expected an integer >= 1 and <= 65536 or null; found 0",
        ),
        (
            {"inner": {"featurs": 0}},
            "stage.inner.featurs: expected one of channels, features; found 'featurs'",
        ),
        ({"inner": 3}, "stage.inner: expected a mapping of its keys; found 3"),
        (
            {"inner": {"channels": [1]}},
            "stage.inner.channels: expected a list of 2 values (each an integer >= 1",
        ),
        ({"size": [1, 2, 3]}, "or a list of 2 values (each an integer >= 1 and <= 8192); found [1, 2, 3]"),
        ({"path": True}, "stage.path: expected a path or null; found True"),
        (
            {"path": "~nosuchuser/x"},
            "stage.path: expected a path, after ~ nothing or a user of",
        ),
        ({"per": "some"}, "stage.per: expected an integer >= 1 or all; found 'some'"),
        ({"name": ""}, "stage.name: expected a text; found ''"),
        (
            {"shares": {"x": 2}},
            "stage.shares: expected a mapping (each a number >= 0 and <= 1); found {'x': 2}",
        ),
        ({"start": 0.95, "mode": "b"}, "stage.start: expected less than 0.9 with mode=b; found 0.95"),
    ],
)
def test_a_wrong_value_is_named(values, message):
    for make in (lambda: Outer(**values), lambda: Outer.read(values, "stage")):
        with pytest.raises(InputError) as caught:
            make()
        assert message in str(caught.value)


def test_lists_and_integers_are_taken_and_nothing_changes_afterwards():
    options = Outer.read(
        {"size": [3, 4], "start": 0.25, "inner": {"channels": [4, 5]}, "shares": {"x": 1}}, "x"
    )
    assert (options.size, options.inner.channels, options.shares) == ((3, 4), (4, 5), {"x": 1.0})
    changed = options.replace(start=0.5)
    assert (changed.start, changed.size, options.start) == (0.5, (3, 4), 0.25)
    with pytest.raises(ValueError, match="frozen"):
        options.start = 0.1
    with pytest.raises(InputError, match=r"stage\.start"):
        options.replace(start=2)


def test_meanings_are_the_texts_below_the_fields():
    assert meaning_of(Outer, "start") == "Share of the way\nat the start."


class _Person(Options):
    name: Text = "x"
    folder: PathText | None = None
    others: Texts = ()
    steps: Count | None = None


@pytest.mark.parametrize(
    ("given", "read"),
    [
        ({"name": 100846}, {"name": "100846"}),
        ({"folder": 2024}, {"folder": "2024"}),
        ({"others": [1, "0426"]}, {"others": ("1", "0426")}),
    ],
)
def test_options_take_numbers_as_names(given, read):
    assert {key: getattr(_Person(**given), key) for key in read} == read


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"folder": 2024.1}, "folder: expected a text .in quotes where it spells a number: .*; found 2024.1"),
        ({"name": True}, "name: expected a text; found True"),
        ({"steps": "1_0x"}, "steps: expected an integer >= 1 or null; found '1_0x'"),
    ],
)
def test_other_values_are_refused_by_name(given, message):
    with pytest.raises(InputError, match=message):
        _Person(**given)
