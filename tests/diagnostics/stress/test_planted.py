"""The stress test reports each of a list of defects, which are planted in the code one at a time."""

import ast
import importlib
import inspect
import json
import textwrap
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path

import numpy as np
import pytest

from ghgs_lit.diagnostics.stress import stages
from ghgs_lit.diagnostics.stress.measure import measure
from ghgs_lit.diagnostics.stress.whole import STAGES
from ghgs_lit.ops.rasterization import cpu
from tests.helpers.planting import CODE, change_code, found

#: What is wrong, where, the change, and the stage, family and dtype that show it.
DEFECTS = json.loads(Path(__file__).with_name("planted.json").read_text())


def plant(at: str, change: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Change the code of a function until the test ends."""
    file, name = found(CODE, at)
    module = importlib.import_module(file.removesuffix(".py").removesuffix("/__init__").replace("/", "."))
    function = inspect.unwrap(attrgetter(name)(module))
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))
    change_code(tree, change)
    changed: dict[str, Callable] = {}
    exec(ast.unparse(tree), vars(module), changed)
    monkeypatch.setattr(function, "__code__", inspect.unwrap(changed[function.__name__]).__code__)


def failures(stage: str, family: str, dtype: str) -> int:
    """Number of failures among three cases."""
    return sum(row["failures"] for row in measure(STAGES[stage], family, 3, [dtype]))


@pytest.mark.parametrize("defect", DEFECTS, ids=lambda defect: defect["what"])
def test_a_changed_line_is_reported(defect, monkeypatch):
    """The same cases pass without the defect."""
    case = defect["stage"], defect["family"], defect["dtype"]
    assert failures(*case) == 0
    plant(defect["at"], defect["change"], monkeypatch)
    assert failures(*case) > 0


def test_a_confidence_without_its_limit_is_reported(monkeypatch):
    """exp(100) is infinite in float32, but not in float64."""
    monkeypatch.setattr(stages.activation, "confidence_of", lambda c: 1 + c.exp())
    assert failures("depth activation", "saturated", "float32") > 0


def test_a_norm_without_its_epsilon_is_reported(monkeypatch):
    """The norm of tokens of 0 is 0."""
    for head in stages.HEADS.values():
        monkeypatch.setattr(head.norm, "eps", 0.0)
    assert failures("dense head", "zero_features", "float32") > 0


def test_tiles_from_back_to_front_are_reported(monkeypatch):
    """Splats of a tile must be sorted by their depths."""
    right = cpu.scatter

    def reversed_(first, last, shifts, depths, *rest):
        with np.errstate(all="ignore"):
            return right(first, last, shifts, (1 / depths).astype(np.float32), *rest)

    monkeypatch.setattr(cpu, "scatter", reversed_)
    assert failures("compositing", "ordinary", "float32") > 0
