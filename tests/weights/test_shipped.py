"""The weights that come with the package."""

import json
import re
from pathlib import Path

import pytest

from ghgs_capture.prediction import trained_size
from ghgs_lit.weights.checkpoint import read_checkpoint
from tests.helpers.models import load_model
from tests.helpers.verbs import ghgs

CARD = Path(__file__).parents[2] / "docs" / "model_card.md"


def test_they_are_what_a_model_without_a_path_has_and_name_no_machine():
    model, config = load_model(), read_checkpoint("shipped")["config"]
    assert model.rounds.height == config["rounds"]["height"] == 202
    assert not model.training
    assert not re.search(r"/(tmp|work|home|root)\b", json.dumps(config))


def test_predictions_are_of_crops_that_need_no_smaller_copy_though_training_saw_larger_ones():
    config = read_checkpoint("shipped")["config"]
    assert config["data"]["size"] == 518
    assert trained_size(config) == 252


def test_their_figures_are_those_of_the_model_card(tmp_path, monkeypatch):
    """Detects a replaced file and changes of the model."""
    monkeypatch.setenv("GHGS_CACHE", str(tmp_path))
    arguments = ["checkpoint=shipped", "data=synthetic", "data.people={train: 1, val: 2}"]
    arguments += ["data.render.positions=[0,2,4,6,8,10,12,14]"]
    arguments += ["evaluation.targets=[release,midway]", f"hydra.run.dir={tmp_path / 'run'}"]
    assert ghgs("evaluate", *arguments) == 0
    rows = json.loads((tmp_path / "run" / "metrics.json").read_text())["rows"]
    found = {(row["subject"], row["targets"]): row["psnr"] for row in rows}
    stated = re.findall(r"\| (p\d+) \| ([\d.]+) \| ([\d.]+) \|", CARD.read_text())
    assert len(stated) == 2
    for person, release, midway in stated:
        assert found[person, "release"] == pytest.approx(float(release), abs=0.05)
        assert found[person, "midway"] == pytest.approx(float(midway), abs=0.05)
