"""``benchmarks/live.py``: which models it times."""

import runpy
import sys
from pathlib import Path

import pytest

from benchmarks import live as script
from ghgs_lit.diagnostics.benchmark.measure import threads
from ghgs_lit.errors import InputError
from tests.helpers.processes import PREPARED

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "live.py"
SMALL = ["--size", "56", "--target", "32", "--repeats", "2", "--threads", "1"]


def live(monkeypatch: pytest.MonkeyPatch, *options: str) -> None:
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *options])
    with threads(1):  # and those of before afterwards
        runpy.run_path(str(SCRIPT), run_name="__main__")


def test_a_checkpoint_in_each_number_of_rounds(monkeypatch, capsys):
    knobs = "knobs={rounds.count:[1,2]}"
    live(monkeypatch, "checkpoint=shipped", *SMALL, "presets=[exact]", knobs)
    rows = [line.split("|")[1].strip() for line in capsys.readouterr().out.splitlines() if line[:2] == "| "]
    counts = [f"{name} rounds.count={count}" for name in ("none", "exact") for count in (1, 2)]
    assert rows == ["ms", "none", *counts]


def test_an_option_of_the_model_beside_a_checkpoint_is_refused(monkeypatch):
    with pytest.raises(InputError, match="encoder"):
        live(monkeypatch, "checkpoint=shipped", *SMALL, "encoder=vggt_small")


def test_frames_in_flight_are_drawn_by_processes(monkeypatch, capsys):
    """Each of which has a part of the threads; the table is that of one frame after the other."""
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), *SMALL, "--in-flight", "2", "presets=[exact]"])
    # spawned ones import all
    monkeypatch.setattr(script.multiprocessing, "get_context", lambda *_: PREPARED)
    with threads(1):
        script.main()
    lines = [line.split("|") for line in capsys.readouterr().out.splitlines() if line[:2] == "| "]
    assert [line[1].strip() for line in lines] == ["ms", "none", "exact"]
    assert lines[0][-2].strip() == "frames a second"
    assert all(float(line[-2]) > 0 for line in lines[1:])
