"""A dry run reports everything that is missing at once."""

import re
import shutil
import sys

import numpy as np
import pytest
import torch

from ghgs_lit.cli import rehearsal
from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import run_of
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.runs.sweep import PlannedRun
from ghgs_lit.weights.checkpoint import write_checkpoint
from tests.cli.test_main import call
from tests.helpers.models import config
from tests.helpers.people import render_boxes

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
    return rehearsal.rehearse([PlannedRun((), (), run, RunDirectory(directory))])


def test_all_that_is_missing_is_said_at_once(monkeypatch, tmp_path):
    """Regression: each problem was found by another run, hours after the plan had passed."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setitem(sys.modules, "torchvision", None)
    monkeypatch.setitem(sys.modules, "wandb", None)
    found = rehearse(
        "init_from=none.ckpt", "resume=gone.ckpt", f"data.root={tmp_path / 'none'}", "trainer=gpu",
        "encoder.layers=[1,2,3]", "metrics.lpips=require", "logger=wandb",
    )  # fmt: skip
    expected = [
        r"encoder\.layers: expected 4 layers, which the dense heads fuse; found \[1, 2, 3\]",
        r"gone\.ckpt: expected",
        r"ghgs-lit\[wandb\]",
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


@pytest.mark.parametrize(
    ("lacking", "said"),
    [
        ("img/{name}_004", r"img/{name}_004/0\.jpg: expected a file of the data set; found none \("),
        ("img/{name}_001/0.*", r"img/{name}_001/0\.jpg: expected a file of the data set; found none$"),
        ("mask/{name}_001/0.png", r"mask/{name}_001/0\.png: expected a file of the data set; found none$"),
        ("parm/{name}_001/0_intrinsic.npy", r"0_intrinsic\.npy: expected a file of the data set; found none"),
        ("smpl/{name}", r"smpl/{name}/vertices\.npy: expected body vertices for loss\.weights\.chamfer=1\.0"),
    ],
)  # fmt: skip
def test_files_that_a_later_step_would_read_are_named(tmp_path, rendered, lacking, said):
    """Regression: a run found them after hours, because the first batch has another subject."""
    root = tmp_path / "some"
    shutil.copytree(rendered, root)
    names = sorted({path.name.rpartition("_")[0] for path in (root / "train" / "img").iterdir()})
    for name in names:  # each one has a body
        folder = root / "train" / "smpl" / name
        folder.mkdir(parents=True, exist_ok=True)
        np.save(folder / "vertices.npy", np.random.default_rng(0).normal(size=(9, 3)) * 0.2)
    run = run_of("train", [*SMALL, f"data.root={root}", "loss=paper"])
    first = {name.split("/")[0] for name in build_data(run).training_batch(0).subjects}
    name = next(name for name in names if name not in first)
    (path,) = (root / "train").glob(lacking.format(name=name))
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    found = rehearse_run(run)
    assert len(found) == 1
    assert re.search(said.format(name=name), found[0].replace("{name}", name)), found


def test_nothing_is_missing_and_nothing_is_written(monkeypatch, capsys, tmp_path, rendered):
    monkeypatch.chdir(tmp_path)
    command = ["-m", *SMALL, f"data.root={rendered}", "seed=1,2", "dry_run=true", "hydra.sweep.dir=sweep"]
    code, out, err = call(monkeypatch, capsys, "train", *command)
    assert code == 0, err
    assert "would be refused" not in out
    alone = [*SMALL, f"data.root={rendered}", "dry_run=true", "hydra.run.dir=alone"]
    code, out, err = call(monkeypatch, capsys, "train", *alone)
    assert code == 0, err
    assert f"outputs below {tmp_path / 'alone'}: config.yaml" in out
    assert not list(tmp_path.iterdir())


def test_what_a_sweep_lacks_ends_its_dry_run_with_an_error(monkeypatch, capsys, tmp_path):
    """Regression: a plan that had passed started jobs that failed. Each reason is reported once."""
    command = ["-m", *SMALL, f"data.root={tmp_path / 'none'}", "seed=1,2", "ablation=full,neither"]
    command += ["dry_run=true", "encoder.layers=[1,2,3]", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    code, out, err = call(monkeypatch, capsys, "train", *command)
    assert code == 1
    assert out.count("would be refused: ") == 2
    assert "dry_run: expected runs that lack nothing; found 2 missing, as said above" in err
    assert not list(tmp_path.iterdir())


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
