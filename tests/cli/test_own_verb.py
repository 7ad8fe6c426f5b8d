"""A user-defined verb: one class in a file outside the package."""

import sys

import pytest

from ghgs_lit.config import registry
from tests.helpers.verbs import ghgs

FILE = '''
from ghgs_lit.cli.verb import Verb
from ghgs_lit.config.options import Count, Text
from ghgs_lit.config.registry import register


@register("verb", "greet")
class Greet(Verb):
    """Greet somebody, several times."""

    example = "ghgs greet name=Ada"

    name: Text
    """Who is greeted."""
    times: Count = 2
    """How often."""

    def run(self):
        print(" ".join([f"hello {self.name}"] * self.times))
'''


@pytest.fixture(autouse=True)
def plug_in(tmp_path, monkeypatch):
    """Write the plug-in to the user's folder and select it by the environment variable."""
    (tmp_path / "own_verb.py").write_text(FILE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(registry, "_REGISTERED", dict(registry._REGISTERED))
    monkeypatch.setenv(registry.VARIABLE, "own_verb.py")
    yield
    sys.modules.pop("own_verb", None)


def test_it_runs_with_its_own_keys(tmp_path, capsys):
    """Without a YAML file."""
    assert ghgs("greet", "name=Ada", "times=3", f"hydra.run.dir={tmp_path / 'run'}") == 0
    assert capsys.readouterr().out == "hello Ada hello Ada hello Ada\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["times=2"], "ghgs greet: name: expected a value"),
        (["name=Ada", "times=0"], "ghgs greet: times: expected an integer >= 1; found 0"),
        (["name=Ada", "time=2"], "did you mean times?"),
    ],
)
def test_wrong_keys_are_refused_in_one_line(tmp_path, capsys, arguments, message):
    assert ghgs("greet", *arguments, f"hydra.run.dir={tmp_path / 'run'}") == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", ["own.verb.py", "none.py"])
def test_a_file_that_cannot_be_imported_is_one_line(tmp_path, monkeypatch, capsys, name):
    """Regression: it was a traceback before a verb was chosen."""
    (tmp_path / "own.verb.py").write_text(FILE)
    monkeypatch.setenv(registry.VARIABLE, name)
    assert ghgs("--help") == 1
    expected = f"expected a Python file without a dot in its name; found '{tmp_path / name}'"
    assert capsys.readouterr().err == f"ghgs: {registry.VARIABLE}: {expected}\n"


def test_a_sweep_of_it_runs_every_combination(capsys):
    assert ghgs("greet", "-m", "name=Ada,Bob", "times=1", "hydra.sweep.dir=sweep") == 0
    out = capsys.readouterr().out
    assert [line for line in out.splitlines() if line.startswith("hello")] == ["hello Ada", "hello Bob"]


def test_help_lists_it(capsys):
    assert ghgs("--help") == 0
    assert "Greet somebody, several times" in capsys.readouterr().out
    assert ghgs("greet", "--help") == 0
    assert "Who is greeted." in capsys.readouterr().out
