"""The GPU benchmark: its sections run in a rehearsal, and a failing one does not stop the others."""

import argparse
import dataclasses
import sys
from contextlib import nullcontext

import pytest
import torch

from benchmarks import gpu
from benchmarks.gpu_measure import DRY, Call, Rows, rehearsal
from benchmarks.gpu_replay import WRONG, judge_optimizer, judge_prediction, judge_step
from benchmarks.gpu_sections import SECTIONS, _enable_capture, _Step
from ghgs_lit.execution import Predictor
from tests.helpers.capture_backends import OperatorBackend, SilentBackend
from tests.helpers.models import make_model
from tests.helpers.pretend_device import DEVICE

TINY = dataclasses.replace(DRY, side=28, batches=(1,), large_batches=(1,), large=28)


@pytest.mark.filterwarnings("ignore:CUDA is not available")
@pytest.mark.parametrize("section", ["machine", "step"])
def test_a_section_runs_in_a_rehearsal(section, tmp_path, one_thread):
    """Runs without a GPU, so that no GPU time is lost to mistakes."""
    with rehearsal() as device:
        call = Call(device, Rows(tmp_path / "rows.jsonl"), section, TINY, tmp_path)
        SECTIONS[section](call)
    found = call.rows.read()
    names = [row["row"] for row in found]
    if section == "machine":
        assert names == [
            "versions",
            "copy",
            *(f"product, {name}" for name in ("float32", "tf32", "bfloat16")),
        ]
    if section == "step":
        parts = ("data", "forward", "render", "loss", "backward", "optimize")
        each = [f"batch of 1: {part}" for part in parts]
        judged = [f"batch of 1, {part}replay beside eager" for part in ("", "optimizer, ")]
        assert names == ["batch of 1", *each, "batch of 1, captured", *judged]
        assert [row["verdict"] for row in found[-2:]] == ["as eager"] * 2
        measured = found[:-2]
        assert all(row["ms"] > 0 and row["launches"] > 0 and len(row["longest"]) <= 40 for row in measured)


class Lossy(OperatorBackend):
    """Backend whose replays omit an operator from its ``first`` call on, as if it had not been captured."""

    def __init__(self, device, operator, first):
        super().__init__(device)
        self.operator, self.first = operator, first

    def capture(self, call):
        result, play = super().capture(call)
        calls = play.__self__.calls
        places = [place for place, each in enumerate(calls) if each[0].name() == self.operator]
        for place in reversed(places[self.first :]):
            del calls[place]
        return result, play


#: None: a replay that is right; those of training steps are judged by the rehearsal of their section.
BACKENDS = {
    "prediction": [None, (SilentBackend,), (Lossy, "aten::addmm", 0)],
    "step": [(SilentBackend,), (Lossy, "aten::mm", -1)],
    "optimizer": [(SilentBackend,), (Lossy, "aten::_foreach_lerp_.Scalar", 0)],
}
PLANTED = [(kind, backend) for kind, backends in BACKENDS.items() for backend in backends]


@pytest.mark.parametrize(("kind", "planted"), PLANTED)
def test_a_wrong_replay_is_seen(kind, planted, tmp_path, one_thread, monkeypatch):
    """A replay that does nothing or omits a single operator is detected."""
    with rehearsal() as device:
        if planted is not None:
            kept, *options = planted
            monkeypatch.setattr(device, "backend", lambda: kept(device.device.type, *options))
        rows = Rows(tmp_path / "rows.jsonl")
        call = Call(device, rows, "step", TINY, tmp_path)
        if kind == "prediction":
            with torch.no_grad():
                predictor = _enable_capture(call, Predictor(make_model("model=hull").eval().to(DEVICE)))
                batch = dataclasses.replace(call.batch(1, 28), targets=None).to(DEVICE)
                for _ in range(2):
                    predictor(batch)
            judge_prediction(call, kind, predictor, batch)
        else:
            step = _Step(call, call.run(*call.shipped), call.batch(1, 28))
            for _ in range(4):
                step.run_captured()
            (judge_step if kind == "step" else judge_optimizer)(call, kind, step)
    [row] = rows.read()
    assert row["verdict"] == ("as eager" if planted is None else WRONG)
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--table", str(tmp_path)])
    with nullcontext() if planted is None else pytest.raises(SystemExit, match="WRONG, a replay"):
        gpu.main()


def test_sections_that_are_named_are_one_run():
    """So that people are rendered while all of them run."""
    runs = gpu.runs_of(["step", "training", "second"])
    assert list(runs) == ["second", "step_training"]
    assert runs["step_training"] == (["step", "training"], 520)


@pytest.fixture
def session(tmp_path, monkeypatch):
    """Run sections whose commands are Python code; returns the rows of results."""

    def run(plans, codes):
        monkeypatch.setattr(gpu.Session, "command", lambda _, name: [sys.executable, "-c", codes[name]])
        options = argparse.Namespace(dry=False, gsplat=tmp_path, work=tmp_path, overrides=[])
        rows = Rows(tmp_path / "first.jsonl")
        gpu.Session(options, rows, plans, 60).run()
        return rows.read()

    return run


def test_a_section_that_fails_or_hangs_stops_no_other(session, tmp_path, monkeypatch, capsys):
    """Its last lines are reported, its results are kept, and tables are made from files alone."""
    line = '{"section": "step", "row": "batch of 8", "ms": 12.5}'
    write = f"open({str(tmp_path / 'first.jsonl')!r}, 'a').write({line + chr(10)!r})"
    codes = {
        "gsplat": "pass",
        "step": f"{write}; raise ValueError('no memory')",
        "kernels": "import time; time.sleep(60)",
        "paper": "pass",
    }
    plans = {
        "step": gpu.Plan(30, ("gsplat",)),
        "kernels": gpu.Plan(1, ("gsplat",), quiet=True),
        "paper": gpu.Plan(30),
    }
    ends = {row["section"]: row["status"] for row in session(plans, codes) if "status" in row}
    assert ends == {"step": "failed", "kernels": "took too long", "paper": "done"}
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--table", str(tmp_path)])
    gpu.main()
    printed = capsys.readouterr().out
    assert "| batch of 8 | 12.5 |" in printed
    assert "ValueError: no memory" in printed


def test_a_section_whose_needs_failed_is_not_run(session):
    """A failed compilation of gsplat is reported once per section, with the compiler's last lines."""
    code = "import sys; sys.exit('nvcc: not found')"
    [row] = session({"step": gpu.Plan(30, ("gsplat",))}, dict.fromkeys(("gsplat", "step"), code))
    assert (row["status"], row["last_lines"]) == ("gsplat failed", ["nvcc: not found"])


def test_a_command_that_is_ended_leaves_no_section_behind(session, monkeypatch):
    """For example at a time limit: remaining processes would share the GPU with later ones."""
    started = []

    def ended(process, _):
        started.append(process.process)
        raise SystemExit("ended by a limit of time")

    monkeypatch.setattr(gpu.Background, "wait", ended)
    with pytest.raises(SystemExit):
        session({"machine": gpu.Plan(30)}, {"machine": "import time; time.sleep(60)"})
    assert [process.poll() is not None for process in started] == [True]
