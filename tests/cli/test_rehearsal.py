"""A dry run reports everything that is missing at once."""

import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from ghgs_lit.cli import rehearsal
from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import run_of
from ghgs_lit.method.model import GHGS
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
    return rehearsal.rehearse([run_of("train", [*SMALL, *overrides])])


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
        assert any(re.search(text, reason) for reason in found.reasons), (text, found.reasons)


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
    assert len(found.reasons) == 1
    assert re.search(expected, found.reasons[0]), found.reasons


def test_weights_of_another_size_are_a_note(tmp_path, rendered):
    """Training starts from the tensors that fit, which may be almost none."""
    small = ["encoder.vit.channels=8", "recalibration.k=8", "recalibration.num_heads=2"]
    path = tmp_path / "small.ckpt"
    model = GHGS.from_config(run_of("train", [*SMALL, *small]).plain)
    write_checkpoint(path, model.state_dict(), config())
    weights = [f"data.root={rendered}", f"init_from={path}", *small]
    assert not [note for note in rehearse(*weights).notes if "init_from" in note]
    found = rehearse(*weights, "encoder.width=64")
    assert not found.reasons
    (note,) = (note for note in found.notes if note.startswith("init_from"))
    assert re.fullmatch(rf"init_from: \d+ of \d+ tensors have another shape in {path}, and .*", note)


def test_the_room_for_tokens_is_said(rendered):
    """Reported before anything is written: three people in 16 positions, 2 x 2 patches, 32 channels of
    two bytes."""
    encoder = "encoder={width: 32, heads: 2, depth: 4, layers: [0, 1, 2, 3], image_size: 28}"
    frozen = ["encoder=vggt_1b", encoder, "encoder.vit={depth: 2, heads: 2}", "allow_random_encoder=true"]
    found = rehearse(
        f"data.root={rendered}",
        "feature_cache.kind=disk",
        "feature_cache.folder=features",
        "data.size=28",
        *frozen,
    )
    assert not found.reasons
    (note,) = (note for note in found.notes if note.startswith("feature_cache"))
    assert note == "feature_cache: features: tokens of 48 photographs of training, 1.23e-05 GB"
    assert not Path("features").exists()


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
    found = rehearsal.rehearse([run])
    assert len(found.reasons) == 1
    assert re.search(said.format(name=name), found.reasons[0].replace("{name}", name)), found.reasons


def test_nothing_is_missing_and_nothing_is_written(monkeypatch, capsys, tmp_path, rendered):
    monkeypatch.chdir(tmp_path)
    command = ["-m", *SMALL, f"data.root={rendered}", "seed=1,2", "dry_run=true", "hydra.sweep.dir=sweep"]
    code, out, err = call(monkeypatch, capsys, "train", *command)
    assert code == 0, err
    assert "would be refused" not in out
    alone = [*SMALL, f"data.root={rendered}", "dry_run=true", "hydra.run.dir=alone"]
    code, out, err = call(monkeypatch, capsys, "train", *alone)
    assert code == 0, err
    assert f"outputs: {tmp_path / 'alone'}/ with config.yaml" in out
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


def test_people_that_are_not_rendered_are_not_rendered_by_a_plan(tmp_path):
    """Rendering takes minutes."""
    found = rehearsal.rehearse([run_of("train", [f"data.cache_dir={tmp_path}", "loss=depth"])])
    assert found.reasons == []
    assert any("people are rendered before the first step" in note for note in found.notes)
    assert not list(tmp_path.iterdir())
