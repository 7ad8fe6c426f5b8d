"""A user-defined stage in place of each stage of the model: trained, saved, loaded and evaluated."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from ghgs_lit import GHGS
from ghgs_lit.config import registry, run_of
from ghgs_lit.errors import InputError
from ghgs_lit.ply import read_ply
from tests.helpers.figures import Figure
from tests.helpers.models import TINY, load_model, predict
from tests.helpers.people import render_boxes
from tests.helpers.scenes import make_batch
from tests.helpers.verbs import ghgs

FILE = Path(__file__).parent / "fixtures" / "own_stages.py"
GROUPS = (
    "bounds", "encoder", "depth_head", "unprojection", "recalibration", "gaussian_head", "renderer", "loss"
)  # fmt: skip
#: Overrides to repeat for every verb; the model itself comes from the checkpoint.
SAID = {"renderer": ["renderer.kind=mine"], "loss": ["metrics=mine"]}
#: Stages chosen by their kind; the others are chosen by a YAML file.
KINDS = {"bounds", "depth_head", "unprojection", "recalibration", "gaussian_head", "renderer"}


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    """Rendered boxes, one for training and one for evaluation."""
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "rendered", folder / "scans", train=1, val=1)
    return folder / "rendered"


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Four photographs of a figure, with their cameras."""
    folder = tmp_path_factory.mktemp("photographs")
    Figure().write(folder)
    return [f"images={folder}", f"cameras={folder / 'cameras.json'}"]


@pytest.fixture
def project(tmp_path, monkeypatch):
    """A user's folder: a Python file with stages, and a YAML file for each of them."""
    shutil.copy(FILE, tmp_path / "own_stages.py")
    for group in {*GROUPS, "metrics"} - KINDS:
        (tmp_path / "conf" / group).mkdir(parents=True)
        (tmp_path / "conf" / group / "mine.yaml").write_text("kind: mine\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(registry, "_REGISTERED", dict(registry._REGISTERED))
    monkeypatch.setenv(registry.VARIABLE, "own_stages.py")
    yield tmp_path
    sys.modules.pop("own_stages", None)


def test_an_attribute_that_a_stage_lacks_is_named(project):
    file = project / "own_stages.py"
    file.write_text(file.read_text().replace("    is_bounded = True\n", ""))
    registry.verbs()
    nodes = run_of("train", ["model=paper", *TINY]).plain | {"depth_head": {"kind": "mine"}}
    with pytest.raises(InputError, match="depth_head: expected a stage with the attribute is_bounded; found"):
        GHGS.from_config(nodes)


@pytest.mark.parametrize("group", GROUPS)
def test_each_stage_can_be_replaced_alone(project, boxes, photographs, monkeypatch, group):
    """Only the parts of a stage that its protocol describes are used (:mod:`ghgs_lit.method.stages`).

    The checkpoint also contains the weights of a loss; values of a metric are written like all others.
    """
    said = ["--config-dir", "conf", *SAID.get(group, [])]
    chosen = f"{group}.kind=mine" if group in KINDS else f"{group}=mine"
    common = [*said, "views=v3", "evaluation.targets=[midway]", "evaluation.pictures=0"]
    arguments = [
        "model=paper", "data=scans", f"data.root={boxes}", "data.size=28", chosen,
        "trainer.max_steps=2", "logger=none", "callbacks=none", "hydra.run.dir=run",
    ]  # fmt: skip
    arguments += [small for small in TINY if not small.startswith(f"{group}.")]
    assert ghgs("train", *common, *arguments) == 0
    checkpoint = project / "run" / "checkpoints" / "last.ckpt"
    before = json.loads(Path("run/metrics.json").read_text())
    assert before["provenance"]["training"]["steps"] == 2
    with torch.no_grad():
        prediction = predict(load_model(checkpoint), make_batch(1, 3, 28, 28))
    assert len(prediction.gaussians) == int(prediction.depth_valid.sum()) > 0
    assert prediction.gaussians.is_finite.all()
    assert torch.isfinite(prediction.depth).all()
    assert ghgs("evaluate", *common, f"checkpoint={checkpoint}", "hydra.run.dir=measured") == 0
    measured = json.loads(Path("measured/metrics.json").read_text())
    values = [[row["psnr"] for row in content["rows"]] for content in (before, measured)]
    assert np.isfinite(values[0]).all()
    assert values[1] == pytest.approx(values[0], abs=1e-3)
    if group == "loss":
        saved = torch.load(checkpoint)["state_dict"]
        assert saved["losses.log_variance"] != 0  # differs from its initial value
        assert "largest" in measured["provenance"]["protocol"]["reported"]
        assert all(0 < row["largest"] <= 1 for row in measured["rows"])
        said.remove("metrics=mine")
    run = [f"checkpoint={checkpoint}", "out=splat", "formats=[ply]", "turntable.frames=0"]
    assert ghgs("predict", *said, *photographs, *run, "check_cameras=false") == 0
    assert read_ply("splat/gaussians.ply").is_finite.all()
    if group not in ("renderer", "loss"):
        monkeypatch.delenv(registry.VARIABLE)
        del registry._REGISTERED[group, "mine"]
        with pytest.raises(InputError, match=rf"{group}\.kind: expected .*{registry.VARIABLE}"):
            load_model(checkpoint)
