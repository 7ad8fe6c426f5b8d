"""Progress of a run: lines, or a bar on a terminal."""

import dataclasses
import re

import pytest
from rich.console import ConsoleDimensions
from torch.utils.data import DataLoader

from ghgs_lit.rendering import render
from ghgs_lit.runs.progress import Lines, track
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.callbacks import NeighborsAtStart, RunProgress
from ghgs_lit.types import Targets
from tests.helpers.losses import losses_of
from tests.helpers.models import make_model
from tests.helpers.scenes import make_batch
from tests.helpers.training import loader, module, trainer


def test_lines_say_how_far_the_run_is(tmp_path, capsys, monkeypatch):
    """The log of a batch job and train.log show the step, loss, steps per second, remaining time and
    validation."""
    monkeypatch.setattr("ghgs_lit.training.callbacks.Lines.is_due", lambda _: True)
    trainer(tmp_path, steps=12, callbacks=[RunProgress()]).fit(module(), loader(), loader(1))
    lines = (tmp_path / "train.log").read_text().splitlines()
    assert len(lines) == 12
    assert set(lines) <= set(capsys.readouterr().out.splitlines())
    assert re.fullmatch(r"\d\d:\d\d:\d\d step 1 of 12  loss/total \S+", lines[0])
    last = r"step 11 of 12  loss/total \S+  val/psnr \S+  \S+ steps/s  0:00:0\d left"
    assert re.search(last, lines[10])


@pytest.mark.parametrize("width", [80, 160])
def test_a_bar_shows_how_far_the_run_is(width, tmp_path, capsys, monkeypatch):
    """A terminal shows the bar, wrapped if narrow, and train.log gets the lines."""
    monkeypatch.setattr("ghgs_lit.training.callbacks.on_terminal", lambda: True)
    monkeypatch.setattr("ghgs_lit.training.callbacks.Lines.is_due", lambda _: True)
    monkeypatch.setattr("rich.console.Console.size", ConsoleDimensions(width, 25))
    trainer(tmp_path, steps=12, callbacks=[RunProgress()]).fit(module(), loader(), loader(1))
    shown = " ".join(capsys.readouterr().out.split())
    assert re.search(r"100% step 12 of 12 +loss/total .* \S+ steps/s +0:00:00 left", shown)
    assert len((tmp_path / "train.log").read_text().splitlines()) == 12


def test_the_first_step_says_whom_tokens_attend_to(tmp_path, capsys):
    """With more neighbours than tokens both settings share all neighbours, so that the ablation would
    compare nothing."""
    batch = make_batch(1, 3)
    own = Targets(batch.images[:, :1], batch.masks[:, :1], batch.cameras[:, :1])
    batches = DataLoader(
        [dataclasses.replace(batch, targets=own)] * 2, batch_size=None, collate_fn=lambda b: b
    )
    losses, optimization = losses_of({"render_l1": 1.0}), Optimization(lr=1e-3, warmup=0.1, end_factor=0.0)
    learned = GHGSModule(make_model("recalibration.k=1000"), render, losses, optimization)
    callbacks = [NeighborsAtStart()]
    trainer(tmp_path, steps=2, callbacks=callbacks, val_check_interval=None).fit(learned, batches)
    (line,) = re.findall("recalibration: .*", capsys.readouterr().out)
    said = r"recalibration: (\d+) tokens take part, \1 neighbours each, 100% of them the same without .*"
    assert re.fullmatch(said, line)
    assert not learned.model.recalibration._forward_pre_hooks


def test_the_lines_come_once_a_minute(monkeypatch):
    """The log of a run of days has thousands of lines, not millions."""
    now = iter([0.0, 0.0, 30.0, 60.0, 90.0, 125.0])
    monkeypatch.setattr("ghgs_lit.runs.progress.time.monotonic", lambda: next(now))
    lines = Lines()
    assert [lines.is_due() for _ in range(5)] == [True, False, True, False, True]


def test_evaluation_says_how_far_it_is(capsys):
    """A long evaluation without a terminal prints lines, too."""
    assert list(track([1, 2, 3], "measuring", every=0.0)) == [1, 2, 3]
    assert [line.split(" ", 1)[1] for line in capsys.readouterr().out.splitlines()] == [
        "measuring: 1 of 3, 0:00:00",
        "measuring: 2 of 3, 0:00:00",
    ]
