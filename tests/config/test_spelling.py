"""Texts that spell a number keep their spelling, on the command line and in files."""

import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from ghgs_lit.config import compose
from ghgs_lit.config.nodes import Texts
from ghgs_lit.config.options import Count, InputError, Options, PathText, Text
from ghgs_lit.config.reading import reading_as_ghgs


class _Person(Options):
    name: Text = "x"
    folder: PathText | None = None
    others: Texts = ()
    steps: Count | None = None


@pytest.mark.parametrize(
    ("override", "value"),
    [
        ("k=2024_05_17", "2024_05_17"),
        ("k=[0426,1_0,12]", ["0426", "1_0", 12]),
        ("k={1_0:2_0}", {"1_0": "2_0"}),
        ("k=10", 10),
        ("k=+10", 10),
        ("k=-3", -3),
        ("k=1e-4", 1e-4),
        ("hydra.run.dir=1.10", "1.10"),
        ("hydra.sweep.dir=2024_05", "2024_05"),
    ],
)
def test_an_override_keeps_the_spelling_of_names(override, value):
    with reading_as_ghgs():
        assert OverridesParser.create().parse_override(override).value() == value


def test_values_of_a_sweep_keep_theirs():
    with reading_as_ghgs():
        parser = OverridesParser.create()
        for override in ("k=2024_05,0426", "k=choice(2024_05,0426)"):
            swept = parser.parse_override(override).sweep_string_iterator()
            assert list(swept) == ["2024_05", "0426"]
        numbers = parser.parse_override("k=range(1_0,1_2)").sweep_string_iterator()
        assert list(numbers) == ["10", "11"]


def test_a_file_keeps_the_spelling_of_names(tmp_path):
    file = tmp_path / "a.yaml"
    file.write_text("ids: [0426, 2024_05, 12:30:45, 0x1F, 7, 1e-4, '08']")
    with reading_as_ghgs():
        read = list(OmegaConf.load(file).ids)
    assert read == ["0426", "2024_05", "12:30:45", "0x1F", 7, 1e-4, "08"]
    assert list(OmegaConf.create(OmegaConf.to_yaml({"ids": read})).ids) == read  # as runs save it


def test_other_programs_read_as_before():
    assert OverridesParser.create().parse_override("k=1_0").value() in (10, "1_0")
    before = OverridesParser.create().parse_override("k=1_0").value()
    compose("table", ["runs=1_0"])
    assert OverridesParser.create().parse_override("k=1_0").value() == before


@pytest.mark.parametrize(
    ("given", "read"),
    [
        ({"name": 100846}, {"name": "100846"}),
        ({"folder": 2024}, {"folder": "2024"}),
        ({"others": [1, "0426"]}, {"others": ("1", "0426")}),
        ({"steps": "10_000"}, {"steps": 10_000}),
    ],
)
def test_options_take_numbers_as_names_and_spelled_numbers(given, read):
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
