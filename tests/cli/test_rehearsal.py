"""A dry run reports everything that is missing at once."""

import re
import shutil
import sys

import pytest
import torch

from ghgs_lit.cli import rehearsal
from ghgs_lit.config import run_of
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.runs.sweep import PlannedRun
from ghgs_lit.weights.checkpoint import write_checkpoint
from tests.helpers.models import config
from tests.helpers.people import render_boxes
from tests.helpers.verbs import succeed

SMALL = ("data=scans", "data.size=42", "encoder.width=32", "encoder.heads=2", "trainer.max_steps=100")
SMALL += ("evaluation.views=[4]", "loss=depth", "data.workers=1")


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "rendered", folder / "scans", train=3, val=2)
    return str(folder / "rendered")


def rehearse(*overrides):
    return rehearse_run(run_of("train", [*SMALL, *overrides]))


def rehearse_run(run, directory="none"):
    return rehearsal.rehearse([PlannedRun((), run, RunDirectory(directory))])


def test_all_that_is_missing_is_said_at_once(monkeypatch, tmp_path):
    """Regression: each problem was found by another run, hours after the plan had passed."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setitem(sys.modules, "torchvision", None)
    found = rehearse(
        "init_from=none.ckpt", "resume=gone.ckpt", f"data.root={tmp_path / 'none'}", "trainer=gpu",
        "encoder.layers=[1,2,3]", "metrics.lpips=require",
    )  # fmt: skip
    expected = [
        r"encoder\.layers: expected 4 layers, which the dense heads fuse; found \[1, 2, 3\]",
        r"gone\.ckpt: expected",
        r"ghgs-lit\[lpips\]",
        r"none: expected the folder of the data set; found no such folder",
    ]
    for text in expected:
        assert any(re.search(text, reason) for reason in found), (text, found)


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        (["trainer=gpu"], r"trainer\.accelerator: expected a GPU, or cpu .*; found no GPU"),
        (["init_from=none.ckpt"], r"none\.ckpt: expected"),
        (["init_from=other.ckpt"], r"init_from: expected weights that fit the model; found none in other"),
        (
            ["loss=paper", "data.root=bare"],
            r"vertices\.npy: expected body vertices for loss\.weights\.chamfer=1\.0 \(0 .*\); found none",
        ),
        (["encoder.trainable=none"], r"init_from: expected a checkpoint with the encoder's weights"),
        (["evaluation.split=bench"], r"evaluation\.split: expected one of train, val; found 'bench'"),
        (
            ["feature_cache.kind=disk"],
            r"feature_cache: expected none where encoder\.vit is no dinov2 or learns",
        ),
        (["data.size=43"], r"data\.size: expected sides divisible by the patch size 14"),
    ],
)
def test_one_thing_that_is_missing_is_the_one_that_is_said(
    monkeypatch, tmp_path, rendered, overrides, expected
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    shutil.copytree(rendered, "bare", ignore=shutil.ignore_patterns("bodies", "smpl*"))
    write_checkpoint("other.ckpt", {"encoder.nothing": torch.ones(2)}, config())
    found = rehearse(f"data.root={rendered}", *overrides)
    assert len(found) == 1
    assert re.search(expected, found[0]), found


def test_a_single_run_that_lacks_nothing_writes_nothing(monkeypatch, capsys, tmp_path, rendered):
    """Sweeps: tests/cli/test_sweeps_that_lack_files.py."""
    monkeypatch.chdir(tmp_path)
    command = [*SMALL, f"data.root={rendered}", "dry_run=true", "hydra.run.dir=alone"]
    out = succeed(capsys, "train", *command)
    assert f"outputs below {tmp_path / 'alone'}: config.yaml" in out
    assert not list(tmp_path.iterdir())


def test_data_of_several_configurations_are_read_once(monkeypatch, rendered):
    """Ablations share their data, whose files are looked up one by one."""
    read = []
    monkeypatch.setattr(rehearsal, "_read_data", lambda run, data, reasons: read.append(run.data.size))
    variants = ("optimizer.lr=1", "optimizer.lr=2", "data.size=56")
    runs = [run_of("train", [*SMALL, f"data.root={rendered}", variant]) for variant in variants]
    rehearsal.rehearse([PlannedRun((), run, RunDirectory("none")) for run in runs])
    assert read == [(42, 42), (56, 56)]


def test_a_checkpoint_that_a_run_would_resume_from_is_read(tmp_path):
    """Regression: only the queued run reported a damaged one."""
    path = tmp_path / "run" / "checkpoints" / "last.ckpt"
    path.parent.mkdir(parents=True)
    path.write_bytes(b"cut")
    run = run_of("train", [f"data.cache_dir={tmp_path}", "loss=depth"])
    (reason,) = rehearse_run(run, tmp_path / "run")
    assert reason.startswith(f"{path}: expected weights")


def test_people_that_are_not_rendered_are_not_rendered_by_a_plan(tmp_path):
    """Rendering takes minutes."""
    assert rehearse_run(run_of("train", [f"data.cache_dir={tmp_path}", "loss=depth"])) == []
    assert not list(tmp_path.iterdir())
