"""Target protocols, and the verbs from end to end on rendered boxes."""

import fnmatch
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ghgs_lit.data.reader import Photographs
from ghgs_lit.evaluation.baselines import BASELINES
from ghgs_lit.evaluation.measure import ModelMethod, measure_all
from ghgs_lit.metrics import MetricsOptions
from ghgs_lit.ply import read_ply
from ghgs_lit.rendering import Renderer
from ghgs_lit.runs.results import config_hash
from tests.helpers.models import load_model
from tests.helpers.people import rendered
from tests.helpers.training import Standin
from tests.helpers.verbs import ghgs

TRAINING = Path(__file__).parents[2] / "docs" / "training.md"
OFF = MetricsOptions(lpips="off").build()


@pytest.fixture(scope="module")
def trained(boxes, tmp_path_factory):
    """A run of three steps with all outputs."""
    directory = tmp_path_factory.mktemp("train") / "run"
    code = ghgs(
        "train", *data_of(boxes), "trainer.max_steps=3", "trainer.val_check_interval=2", "loss=depth",
        "model=hull", "evaluation.views=[3,4]", "evaluation.pictures=1", f"hydra.run.dir={directory}",
    )  # fmt: skip
    assert code == 0
    return directory


def data_of(root) -> list[str]:
    return ["data=scans", f"data.root={root}", "data.size=42"]


def test_train_writes_everything_that_it_promises(trained):
    """The files of a run are those of the documentation, with the provenance of the numbers."""
    files = {p.relative_to(trained).as_posix() for p in trained.rglob("*") if p.is_file()}
    (table,) = (block for block in TRAINING.read_text().split("\n\n") if "`run.json`" in block)
    rows = re.findall(r"^\| (`.*) \|", table, re.MULTILINE)
    documented = [
        name.replace("<n>", "*") for row in rows for name in re.findall("`([^`]+)`", row.split(" | ")[0])
    ]
    patterns = {name + "*" * name.endswith("/") for name in documented}
    assert {"metrics.json", "checkpoints/best.ckpt", "csv/metrics.csv", "pictures/*"} <= patterns
    assert not [name for name in files if not any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)]
    assert not [pattern for pattern in patterns if not fnmatch.filter(files, pattern)]
    assert {"pictures/model_v3_release_s3.png", "pictures/model_v4_midway_s3.png"} <= files
    assert any(name.startswith("tensorboard/events") for name in files)
    assert not [name for name in files if "=" in name or name.endswith(".tmp")]
    content = json.loads((trained / "metrics.json").read_text())
    assert len(content["rows"]) == 2 * 2 * 2  # subjects, numbers of views, kinds of targets
    source = content["provenance"]
    assert source["protocol"]["metrics"] == "correct"
    assert source["training"]["steps"] == 3
    assert source["config_hash"] == config_hash(source["config"])
    assert source["choices"]["loss"] == "depth"
    assert source["parameters"]["total"] > 0
    assert np.asarray(Image.open(trained / "pictures" / "model_v3_release_s3.png")).max() > 100


def test_a_checkpoint_measures_the_same_again_beside_the_baselines(trained, boxes, tmp_path):
    """`ghgs evaluate` reproduces the numbers of the end of training."""
    path = trained / "checkpoints" / "last.ckpt"
    code = ghgs(
        "evaluate", *data_of(boxes), f"checkpoint={path}", "baselines=all", "evaluation.views=[3]",
        "evaluation.pictures=0", "per_scene.steps=2", f"hydra.run.dir={tmp_path / 'run'}",
    )  # fmt: skip
    assert code == 0
    content = json.loads((tmp_path / "run" / "metrics.json").read_text())
    before = json.loads((trained / "metrics.json").read_text())
    value = {(r["method"], r["subject"], r["targets"]): r for r in content["rows"]}
    for row in before["rows"]:
        if row["views"] == 3:
            again = value["model", row["subject"], row["targets"]]
            assert again["psnr"] == pytest.approx(row["psnr"], abs=1e-3)
    assert {r["method"] for r in content["rows"]} == {"model", *BASELINES}
    assert value["true_depth", "s3", "midway"]["psnr"] > value["nearest_view", "s3", "midway"]["psnr"]


def test_what_is_said_of_a_checkpoints_model_acts_and_is_recorded(trained, tmp_path):
    """`metrics.json` describes the model that ran, on data and targets as given."""
    path = trained / "checkpoints" / "last.ckpt"
    code = ghgs(
        "evaluate", f"checkpoint={path}", "data.workers=0", "targets=midway", "evaluation.views=[3]",
        "recalibration.similarity=none", "recalibration.k=1", "skip=none", "evaluation.pictures=0",
        f"hydra.run.dir={tmp_path / 'run'}",
    )  # fmt: skip
    assert code == 0
    content = json.loads((tmp_path / "run" / "metrics.json").read_text())
    before = json.loads((trained / "metrics.json").read_text())
    value = {(r["subject"], r["views"], r["targets"]): r["psnr"] for r in before["rows"]}
    assert {row["targets"] for row in content["rows"]} == {"midway"}
    assert any(row["psnr"] != value[row["subject"], row["views"], "midway"] for row in content["rows"])
    source = content["provenance"]
    assert (before["provenance"]["ablation"], source["ablation"]) == ("full", "no_semantic")
    ran = source["model_config"]
    assert (ran["recalibration"]["k"], ran["recalibration"]["similarity"]) == (1, "none")
    assert (ran["skip"]["name"], ran["skip"]["pixels"]) == ("none", "all")
    assert source["config"]["recalibration"] == ran["recalibration"]
    assert source["training"] == {"steps": 3}
    assert source["checkpoint_config"]["recalibration"]["similarity"] == "product"
    assert (
        ghgs("evaluate", f"checkpoint={path}", "encoder=vggt_small", f"hydra.run.dir={tmp_path / 'r'}") == 1
    )
    assert not (tmp_path / "r" / "metrics.json").exists()


def test_protocols_are_measured_side_by_side_on_their_own_targets(boxes, tmp_path):
    """One evaluation measures shipped protocols and a user-defined one, none of them selected by targets=."""
    mine = tmp_path / "conf" / "targets" / "mine.yaml"
    mine.parent.mkdir(parents=True)
    mine.write_text("defaults: [rogsplat, _self_]\nname: mine\npositions: [1, 4]\n")
    code = ghgs(
        "evaluate", f"--config-dir={tmp_path / 'conf'}", *data_of(boxes), "baselines=[nearest_view]",
        "evaluation.views=[3]", "evaluation.targets=[ghg,mine,release]", "targets.per_subject=2",
        "evaluation.pictures=0", f"hydra.run.dir={tmp_path / 'run'}",
    )  # fmt: skip
    assert code == 0
    content = json.loads((tmp_path / "run" / "metrics.json").read_text())
    seen = {}
    for row in content["rows"]:
        seen.setdefault(row["targets"], []).append(row["target"])
    assert seen == {
        "ghg": ["003/0", "008/0", "013/0"] * 2,
        "mine": ["001/3", "004/3"] * 2,
        "release": ["000/3", "005/3"] * 2,
    }
    protocols = content["provenance"]["protocol"]["target_protocols"]
    assert list(protocols) == content["provenance"]["protocol"]["targets"] == ["ghg", "mine", "release"]
    assert (protocols["mine"]["kind"], protocols["mine"]["positions"]) == ("cameras", [1, 4])
    assert protocols["release"]["per_subject"] == 2


def test_all_protocols_are_measured_from_one_prediction_with_equal_numbers(boxes, tmp_path):
    """A subject is predicted once for each number of views; each protocol has its rows and pictures."""
    views = {"training_counts": [3], "evaluation_count": 3}
    data = rendered(boxes, views, {"name": "release"}, size=42)
    protocols = {name: {"name": name} for name in ("midway", "release")}
    protocols["midway"]["per_subject"] = 2
    predictions = []

    class Counting(Standin):
        def forward(self, batch):
            predictions.append(batch.subjects)
            return super().forward(batch)

    method = {"model": ModelMethod(Counting(), Renderer(backend="cpu"))}

    def rows_of(names, pictures=None):
        chosen = {name: protocols[name] for name in names}
        rows = measure_all(method, data, [3], chosen, "val", OFF, "cpu", pictures, 1)
        return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]

    together = rows_of(protocols, tmp_path)
    assert predictions == [("s3",), ("s4",)]
    assert [row["targets"] for row in together] == ["midway"] * 4 + ["release"] * 2
    for row, alone in zip(together, rows_of(["midway"]) + rows_of(["release"]), strict=True):
        numbers = [name for name in row if isinstance(row[name], float)]
        assert [row.pop(name) for name in numbers] == pytest.approx([alone.pop(n) for n in numbers], rel=1e-5)
        assert row == alone
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "model_v3_midway_s3.png", "model_v3_release_s3.png",
    ]  # fmt: skip
    heights = [Image.open(tmp_path / f"model_v3_{name}_s3.png").height for name in protocols]
    assert heights[0] > heights[1]


def test_predict_writes_a_splat_that_renders_and_a_turntable(trained, boxes, tmp_path):
    """A subject becomes a PLY and pictures; an unknown subject is rejected."""
    path = trained / "checkpoints" / "last.ckpt"
    arguments = [
        *data_of(boxes),
        f"checkpoint={path}",
        "turntable.frames=3",
        f"hydra.run.dir={tmp_path / 'r'}",
    ]
    assert ghgs("predict", *arguments, "subject=1") == 0
    assert len(read_ply(tmp_path / "r" / "gaussians.ply")) > 50
    assert len(list((tmp_path / "r" / "turntable").glob("*.png"))) == 3
    assert np.asarray(Image.open(tmp_path / "r" / "turntable" / "000.png")).max() > 50
    assert ghgs("predict", *arguments, "subject=nobody") == 1


def test_predict_reads_the_photographs_of_one_subject(trained, tmp_path, monkeypatch):
    """A large data set must not be read up to the subject; targets are read only on request."""
    read = []
    view = Photographs.view

    def recorded(self, name, position, number=0, depth=True, size=None):
        read.append((name, position, number))
        return view(self, name, position, number, depth, size)

    monkeypatch.setattr(Photographs, "view", recorded)
    path = trained / "checkpoints" / "last.ckpt"
    arguments = [f"checkpoint={path}", "subject=s4", "turntable.frames=0", f"hydra.run.dir={tmp_path / 'r'}"]
    assert ghgs("predict", *arguments) == 0
    inputs = [("s4", position, 0) for position in (0, 4, 8, 12)]
    assert read == inputs
    assert (tmp_path / "r" / "sheet.png").exists()
    read.clear()
    assert ghgs("predict", *arguments, "targets=release") == 0
    assert read == [*inputs, ("s4", 0, 3)]


def test_two_processes_train_together_and_write_once(boxes, tmp_path):
    """Only one of several processes writes, and the checkpoint loads."""
    directory = tmp_path / "run"
    command = [
        sys.executable, "-m", "ghgs_lit", "train", *data_of(boxes), "trainer.devices=2",
        "trainer.max_steps=2", "evaluation.pictures=0", "evaluation.targets=[release]",
        "evaluation.views=[3]",
        f"hydra.run.dir={directory}",
    ]  # fmt: skip
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.count("wrote ") == 1
    # events.out.tfevents.<time>.<host>.<process>.<number>
    assert len({p.name.split(".")[-2] for p in directory.rglob("events*")}) == 1
    content = json.loads((directory / "metrics.json").read_text())
    training = content["provenance"]["training"]
    assert (training["steps"], training["processes"]) == (2, 2)
    assert min(training["seconds"], training["peak_bytes"]) > 0
    assert load_model(directory / "checkpoints" / "last.ckpt") is not None


def test_two_seeds_of_an_evaluation_differ_and_one_repeats(boxes, tmp_path):
    """Random targets depend on the given seed."""
    run = [
        "evaluate", *data_of(boxes), "baselines=[nearest_view]", "evaluation.views=[3]",
        "evaluation.targets=[random]", "evaluation.pictures=0",
    ]  # fmt: skip
    targets = []
    for number, seed in enumerate((1, 1, 2)):
        where = tmp_path / str(number)
        assert ghgs(*run, f"seed={seed}", f"hydra.run.dir={where}") == 0
        targets.append([row["target"] for row in json.loads((where / "metrics.json").read_text())["rows"]])
    assert len(targets[0]) == 2  # one of each subject
    assert targets[0] == targets[1] != targets[2]
