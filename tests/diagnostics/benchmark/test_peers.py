"""``ghgs benchmark task=peers``: all methods on the same people, interrupted and gone on with."""

import json

import pytest

from ghgs_lit.diagnostics.benchmark import peers
from ghgs_lit.evaluation.measure import measure
from ghgs_lit.weights.checkpoint import write_checkpoint
from tests.helpers.models import config, make_model
from tests.helpers.people import render_boxes
from tests.helpers.verbs import ghgs

METHODS = ["model", "nearest_view", "hull", "per_scene"]


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """A run of a tiny model on two boxes."""
    folder = tmp_path_factory.mktemp("peers")
    render_boxes(folder / "rendered", folder / "scans", train=1, val=2)
    write_checkpoint(folder / "tiny.ckpt", make_model().state_dict(), config())
    return [
        "benchmark", "task=peers", f"checkpoint={folder / 'tiny.ckpt'}", "data=scans",
        f"data.root={folder / 'rendered'}", "data.size=42", "metrics.lpips=off", "threads=1",
        "baselines=[nearest_view,hull,per_scene]", "evaluation.views=[2,3]", "per_scene.steps=2",
    ]  # fmt: skip


class Measured(list):
    """What is measured, as (method, views, subject); Ctrl-C comes before number ``stop``."""

    stop = None

    def __call__(self, method, name, loader, *rest):
        if len(self) == self.stop:
            raise KeyboardInterrupt
        self.append((name, loader[0].images.shape[1], loader[0].subjects[0]))
        return measure(method, name, loader, *rest)


@pytest.fixture
def measured(monkeypatch):
    calls = Measured()
    monkeypatch.setattr(peers, "measure", calls)
    return calls


def test_a_run_that_was_interrupted_goes_on_where_it_stopped(command, measured, tmp_path, capsys):
    """Nothing is measured twice, and all files are there in the end."""
    run = [*command, f"hydra.run.dir={tmp_path / 'run'}"]
    measured.stop = 5
    assert ghgs(*run) != 0
    assert len(measured) == 5
    assert not (tmp_path / "run" / "benchmark.json").exists()
    measured.stop = None
    assert ghgs(*run) == 0
    out = capsys.readouterr().out
    assert "subjects.jsonl: 5 of 16 measurements are done already" in out
    assert out.strip().splitlines()[-1] == f"wrote {tmp_path / 'run' / 'benchmark.json'}"
    assert len(set(measured)) == len(measured) == 16

    content = json.loads((tmp_path / "run" / "benchmark.json").read_text())
    found = [(row["views"], row["method"], row["targets"]) for row in content["rows"]]
    expected = [(v, m, t) for v in (2, 3) for m in METHODS for t in ("release", "midway")]
    assert sorted(found) == sorted(expected)
    assert all(row["seconds"] > 0 and row["subjects"] == 2 for row in content["rows"])
    assert all(row["psnr_box"] is not None for row in content["rows"])
    assert len(content["subjects"]) == 32
    assert "| per_scene |" in (tmp_path / "run" / "benchmark.md").read_text()


def test_a_further_question_measures_what_is_missing_and_a_setting_everything(command, measured, tmp_path):
    """A further method or subject is measured alone; numbers of other settings are not taken over."""
    run = [*command, f"hydra.run.dir={tmp_path / 'run'}", "evaluation.views=[2]"]
    assert ghgs(*run, "baselines=hull", "subjects=1") == 0
    assert [name for name, *_ in measured] == ["model", "hull"]
    assert ghgs(*run, "baselines=[hull,nearest_view]", "subjects=1") == 0
    assert [name for name, *_ in measured][2:] == ["nearest_view"]
    assert ghgs(*run, "baselines=hull", "subjects=1", "per_scene.steps=3") == 0
    assert [name for name, *_ in measured][3:] == ["model", "hull"]


def test_seconds_are_the_median_of_the_subjects():
    """The first one of a run waits for kernels."""
    about = {"method": "hull", "views": 3, "targets": "midway", "psnr": 20.0}
    rows = [{**about, "subject": str(i), "seconds": s} for i, s in enumerate((9.0, 1.0, 1.5))]
    [row] = peers.peer_rows(rows)
    assert row["seconds"] == 1.5
    [table] = peers.tables_of([row]).values()
    assert table.to_numpy().tolist() == [["3", "hull", "20.00", "1.50"]]


def test_what_cannot_be_combined_is_refused(command, tmp_path, capsys):
    """In one line with the key."""
    run = [*command, f"hydra.run.dir={tmp_path / 'run'}"]
    assert ghgs(*run, "baselines=[white]") == 1
    assert "baselines: expected" in capsys.readouterr().err
    assert ghgs(*run, "knobs={recalibration.k:[2]}") == 1
    assert "knobs: expected null with task=peers" in capsys.readouterr().err
    assert ghgs(*run, "split=bench") == 1
    assert "split: expected one of train, val" in capsys.readouterr().err
