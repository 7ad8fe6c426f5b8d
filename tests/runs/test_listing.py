"""The list of all runs: what they were started with, how far they are, how good they are."""

import json

import pytest
import yaml

from ghgs_lit.errors import InputError
from ghgs_lit.runs.listing import list_runs
from tests.helpers.tables import start_run, write_run
from tests.helpers.verbs import ghgs


def test_every_run_has_its_state_best_figure_and_overrides(tmp_path, capsys):
    """Finished, begun and planned runs are told apart; other verbs are left out."""
    write_run(tmp_path / "runs" / "a", "full", 20.0)
    (tmp_path / "runs" / "a" / ".hydra").mkdir()
    for name, content in (("overrides", ["seed=1", "model=hull"]), ("config", {"trainer": {}})):
        (tmp_path / "runs" / "a" / ".hydra" / f"{name}.yaml").write_text(yaml.safe_dump(content))
    start_run(tmp_path / "runs" / "b", "full", seed=2)
    (tmp_path / "runs" / "b" / "checkpoints").mkdir()
    (tmp_path / "runs" / "b" / "checkpoints" / "last.ckpt").touch()
    (tmp_path / "runs" / "b" / "csv").mkdir()
    (tmp_path / "runs" / "b" / "csv" / "metrics.csv").write_text("step,val/psnr\n1,18.5\n2,\n3,19.25\n")
    start_run(tmp_path / "runs" / "c", "full", seed=3)
    (tmp_path / "runs" / "table").mkdir()
    (tmp_path / "runs" / "table" / "config.yaml").write_text("layout: ablation")
    lines = list_runs([tmp_path / "runs"]).to_dict("records")
    assert [line.pop("run") for line in lines] == [str(tmp_path / "runs" / name) for name in "abc"]
    assert lines == [
        {"state": "done", "best": "25.00 dB (model, 5 views, release)", "overrides": "seed=1 model=hull"},
        {"state": "partial", "best": "19.25 dB (validation)", "overrides": ""},
        {"state": "missing", "best": "", "overrides": ""},
    ]
    assert ghgs("table", f"runs={tmp_path / 'runs'}", "list=true", f"hydra.run.dir={tmp_path / 't'}") == 0
    assert "seed=1 model=hull" in capsys.readouterr().out
    assert (tmp_path / "t" / "runs.csv").read_text().startswith("run,state,best,overrides\n")


def test_folders_without_runs_are_refused(tmp_path):
    """In one line with the folder."""
    with pytest.raises(InputError, match="expected runs below it; found none"):
        list_runs([tmp_path])
    with pytest.raises(FileNotFoundError, match="nowhere"):
        list_runs([tmp_path / "nowhere"])


def test_damaged_results_are_no_results(tmp_path):
    """A run whose results are not whole is not done."""
    path = write_run(tmp_path / "a", "full", 20.0)
    path.write_text(json.dumps({"format_version": 3}))
    assert list_runs([tmp_path])["state"].tolist() == ["missing"]
