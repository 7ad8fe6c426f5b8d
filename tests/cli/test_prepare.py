"""``ghgs prepare`` on intentionally incomplete data."""

import json

import pytest

from ghgs_lit.config import build, compose
from tests.cli.test_main import call
from tests.helpers.people import write_obj_scan

RENDER = ("render.size=42", "render.samples=1", "render.positions=[0,4,8,12]", "render_workers=0", "size=42")


@pytest.fixture
def scans(tmp_path):
    for name in ("s0", "s1"):
        write_obj_scan(tmp_path / "scans", name)
    return tmp_path / "scans"


def test_data_without_training_people_can_be_made_and_evaluated(monkeypatch, capsys, scans, tmp_path):
    """A split with an empty ``train`` renders its val people, and task=check passes with a note."""
    keys = ["data=scans", f"data.source={scans}", f"data.root={tmp_path / 'out'}"]
    keys += [f"data.{key}" for key in RENDER] + ["data.split={train: [], val: [s0, s1]}"]
    run = (f"hydra.run.dir={tmp_path / 'run'}",)
    code, _, err = call(monkeypatch, capsys, "prepare", "task=render", *keys, *run)
    assert (code, err.count("expected")) == (0, 0)
    code, _, err = call(monkeypatch, capsys, "prepare", "task=check", *keys, *run)
    assert code == 0, err
    content = json.loads((tmp_path / "run" / "check.json").read_text())
    assert [phase["subjects"] for phase in content["phases"].values()] == [2]
    assert content["notes"][0].startswith("train: expected subjects to train on; found none")
    cfg = compose("prepare", keys)
    data = build(cfg.data, "data", views=cfg.views, targets=cfg.targets, seed=0)
    assert next(iter(data.evaluation_loader())).subjects == ("s0",)
