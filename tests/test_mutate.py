"""Mutants are changes in one place, killed by failing tests."""

import json
import runpy
from pathlib import Path

import pytest

mutate = runpy.run_path(str(Path(__file__).parents[1] / "scripts/mutate.py"))
CASES = [
    ("a < b", "a <= b"), ("a + b", "a - b"), ("a or b", "a and b"), ("f(a, b)", "f(b, a)"), ("1.0", "2.0"),
    ("True", "False"), ("raise error", "pass"), ("x if a else b", "x if (not a) else b"),
]  # fmt: skip


@pytest.mark.parametrize(("code", "changed"), CASES)
def test_one_place_is_changed(code, changed, tmp_path, monkeypatch):
    """The first mutant of a statement; the surrounding text stays."""
    monkeypatch.setitem(mutate["mutants_of"].__globals__, "ROOT", tmp_path)
    line = code if code.startswith("raise") else f"y = {code}  # é"
    (tmp_path / "a.py").write_text(f"'''Text.'''\n{line}\n")
    ((mutant, *_),) = mutate["mutants_of"](tmp_path / "a.py")
    text = (tmp_path / "a.py").read_text()
    mutated = text[: mutant.start] + mutant.after + text[mutant.start + len(mutant.before) :]
    assert mutated.replace("(" + changed + ")", changed) == text.replace(code, changed)


def test_a_test_that_fails_kills(tmp_path):
    """One test detects the change, another runs the line without assertions."""
    (tmp_path / "own.py").write_text("def add(a, b):\n    return a + b\n")
    tests = ["from own import add", "def test_sees(): assert add(1, 2) == 3", "def test_blind(): add(1, 2)"]
    (tmp_path / "test_own.py").write_text("\n".join(tests))
    mutant = mutate["Mutant"]("own.py", 2, "arithmetic", "a + b", "(a - b)", 29)
    outcomes = {
        name: mutate["outcome_of"](mutant, tests, tmp_path, 60.0)
        for name, tests in {
            "sees": ["test_own.py::test_sees"], "blind": ["test_own.py::test_blind"], "none": [],
        }.items()
    }  # fmt: skip
    assert outcomes == {"sees": "killed", "blind": "survived", "none": "not covered"}
    assert (tmp_path / "own.py").read_text() == "def add(a, b):\n    return a + b\n"


def test_the_fastest_tests_of_a_line_come_first():
    """Without tests of its line, those of its file; without these, those of its package."""
    lines = {"p/a.py": {"1": ["slow", "fast"], "2": []}, "p/b.py": {}}
    covered = json.loads(json.dumps({"lines": lines, "seconds": {"slow": 2.0, "fast": 1.0}}))
    for path, line in [("p/a.py", 1), ("p/a.py", 2), ("p/b.py", 7)]:
        mutant = mutate["Mutant"](path, line, "", "", "", 0)
        assert mutate["tests_of"](mutant, covered, 60.0) == ["fast", "slow"]
    assert mutate["tests_of"](mutant, covered, 1.5) == ["fast"]
