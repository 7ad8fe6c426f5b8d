"""A stage of one's own in the place of each of the model's: trained, saved, loaded and measured."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from ghgs_lit import GHGS
from ghgs_lit.config import plugins, registry
from ghgs_lit.errors import InputError
from tests.helpers.people import render_boxes
from tests.helpers.scenes import make_batch
from tests.helpers.verbs import ghgs

FILE = Path(__file__).parent / "fixtures" / "own_stages.py"
GROUPS = (
    "bounds", "encoder", "depth_head", "unprojection", "recalibration", "gaussian_head", "renderer", "loss"
)  # fmt: skip


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    """Rendered boxes, one to train with and one to measure."""
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "rendered", folder / "scans", train=1, val=1)
    return folder / "rendered"


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A user's folder: a Python file of stages, and a YAML for each of them."""
    shutil.copy(FILE, tmp_path / "own_stages.py")
    for group in GROUPS:
        (tmp_path / "conf" / group).mkdir(parents=True)
        (tmp_path / "conf" / group / "mine.yaml").write_text("kind: mine\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(registry, "_REGISTERED", {})
    monkeypatch.setenv(plugins.VARIABLE, "own_stages.py")
    yield tmp_path
    sys.modules.pop("own_stages", None)


@pytest.mark.parametrize("group", GROUPS)
def test_each_stage_can_be_replaced_alone(project, boxes, monkeypatch, group):
    """Nothing else of a stage is used than what its protocol says (:mod:`ghgs_lit.stages`)."""
    common = ["--config-dir", "conf", "views=v3", "evaluation.targets=[midway]", "evaluation.pictures=0"]
    arguments = [
        "model=paper", "data=scans", f"data.root={boxes}", "data.size=42", f"{group}=mine",
        "trainer.max_steps=2", "logger=none", "callbacks=none", "hydra.run.dir=run",
    ]  # fmt: skip
    assert ghgs("train", *common, *arguments) == 0
    checkpoint = project / "run" / "checkpoints" / "last.ckpt"
    before = json.loads(Path("run/metrics.json").read_text())
    assert before["provenance"]["training"]["steps"] == 2
    with torch.no_grad():
        prediction = GHGS.from_checkpoint(checkpoint)(make_batch(1, 3, 42, 42))
    assert len(prediction.gaussians) == int(prediction.depth_valid.sum()) > 0
    assert prediction.gaussians.is_finite.all()
    assert torch.isfinite(prediction.depth).all()
    again = [f"checkpoint={checkpoint}", "hydra.run.dir=measured"]
    again += [f"{group}=mine"] * (group == "renderer")  # the only one that a checkpoint does not bring
    assert ghgs("evaluate", *common, *again) == 0
    measured = json.loads(Path("measured/metrics.json").read_text())
    values = [[row["psnr"] for row in content["rows"]] for content in (before, measured)]
    assert np.isfinite(values[0]).all()
    assert values[1] == pytest.approx(values[0], abs=1e-3)
    if group not in ("renderer", "loss"):
        monkeypatch.delenv(plugins.VARIABLE)
        registry._REGISTERED.clear()
        with pytest.raises(InputError, match=rf"{group}\.kind: expected .*{plugins.VARIABLE}"):
            GHGS.from_checkpoint(checkpoint)
