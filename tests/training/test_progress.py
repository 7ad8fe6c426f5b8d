"""Progress of a run in lines."""

import re

from ghgs_lit.training.callbacks import RunProgress
from tests.helpers.training import loader, module, trainer


def test_lines_say_how_far_the_run_is(tmp_path, capsys, monkeypatch):
    """The log of a batch job and train.log show the step, loss, steps per second, remaining time and
    validation."""
    monkeypatch.setattr("ghgs_lit.training.callbacks.EVERY", 0.0)
    trainer(tmp_path, steps=12, callbacks=[RunProgress()]).fit(module(), loader(), loader(1))
    lines = (tmp_path / "train.log").read_text().splitlines()
    assert len(lines) == 12
    assert set(lines) <= set(capsys.readouterr().out.splitlines())
    assert re.fullmatch(r"\d\d:\d\d:\d\d step 1 of 12  loss/total \S+", lines[0])
    last = r"step 11 of 12  loss/total \S+  val/psnr \S+  \S+ steps/s  0:00:0\d left"
    assert re.search(last, lines[10])


def test_the_lines_come_once_a_minute(tmp_path, monkeypatch):
    """The log of a run of days has thousands of lines, not millions."""
    monkeypatch.setattr("ghgs_lit.training.callbacks.EVERY", 1e9)
    trainer(tmp_path, steps=12, callbacks=[RunProgress()]).fit(module(), loader(), loader(1))
    (line,) = (tmp_path / "train.log").read_text().splitlines()
    assert "step 1 of 12" in line
