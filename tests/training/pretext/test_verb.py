"""``ghgs pretext``, and ``ghgs train`` that starts from it."""

import json

import numpy as np
import pytest
import torch

from ghgs_lit.evaluation.tables.variants import model_variant
from ghgs_people.figures.body import BODY_VERTICES, load_body
from tests.helpers.models import load_model
from tests.helpers.people import render_boxes
from tests.helpers.verbs import ghgs

BRANCH = "encoder.semantic={width: 16, depth: 1, heads: 2, channels: 8}"
TINY = ["encoder.width=32", "encoder.heads=2", "encoder.vit.channels=8", "recalibration.num_heads=2"]
TINY += ["evaluation.views=[3]", "evaluation.pictures=0", "logger=none", "callbacks=none"]
TINY += ["evaluation.targets=[release]", "trainer.limit_val_batches=0"]
EACH = "kind: checkpoints, filename: 'at_{step}', every_n_train_steps: 2"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Boxes that are said to be built-in people: what the labels say does not matter here."""
    folder = tmp_path_factory.mktemp("bodies")
    render_boxes(folder / "rendered", folder / "scans", train=2, val=1)
    vertices = load_body().mean[:BODY_VERTICES].astype(np.float32)
    for path in (folder / "rendered").glob("*/smpl/*/vertices.npy"):
        np.save(path, vertices)
    return ["data=scans", f"data.root={folder / 'rendered'}", "data.size=42", "data.batch_size=2"]


@pytest.fixture(scope="module")
def pretrained(data, tmp_path_factory):
    """A run of four steps, with a checkpoint after two."""
    directory = tmp_path_factory.mktemp("pretext") / "run"
    steps = ["trainer.max_steps=4", "trainer.val_check_interval=2", f"+callbacks.each={{{EACH}}}"]
    assert ghgs("pretext", *data, BRANCH, *steps, f"hydra.run.dir={directory}") == 0
    return directory


def read(path):
    return torch.load(path, weights_only=True)


def test_the_checkpoint_holds_the_branch_and_its_configuration(pretrained):
    """Models load it by the names of their own tensors; tables read where its features are from."""
    checkpoint = read(pretrained / "checkpoints" / "last.ckpt")
    beginnings = {".".join(name.split(".")[:3]) for name in checkpoint["state_dict"]}
    assert beginnings == {"model.encoder.semantic"}
    assert checkpoint["config"]["encoder"]["weights"] == "pretext"
    assert checkpoint["config"]["encoder"]["semantic"]["width"] == 16
    assert (pretrained / "checkpoints" / "best.ckpt").is_file()
    assert (pretrained / "config.yaml").is_file()
    assert "val/part_accuracy" in (pretrained / "csv" / "metrics.csv").read_text().splitlines()[0]


def test_a_run_resumes_where_it_stopped(pretrained, data, tmp_path):
    """Weights and optimizer of half a run go on to those of the whole one."""
    resume = f"resume={pretrained / 'checkpoints' / 'at_2.ckpt'}"
    steps = ["trainer.max_steps=4", "trainer.val_check_interval=2", "logger=none"]
    assert ghgs("pretext", *data, BRANCH, *steps, resume, f"hydra.run.dir={tmp_path}") == 0
    whole, half = (read(folder / "checkpoints" / "last.ckpt") for folder in (pretrained, tmp_path))
    assert whole["global_step"] == half["global_step"] == 4
    for name, value in whole["state_dict"].items():
        torch.testing.assert_close(half["state_dict"][name], value, msg=name)


def test_a_model_starts_from_it_and_leaves_it_as_it_is(pretrained, data, tmp_path):
    """After training the branch is still that of the pretext stage,
    and counts as one that holds parts."""
    source = pretrained / "checkpoints" / "last.ckpt"
    options = [
        *data,
        BRANCH,
        *TINY,
        f"init_from={source}",
        "trainer.max_steps=1",
        f"hydra.run.dir={tmp_path}",
    ]
    assert ghgs("train", *options) == 0
    before, after = (read(path)["state_dict"] for path in (source, tmp_path / "checkpoints" / "last.ckpt"))
    branch = [name for name in before if name.startswith("model.encoder.semantic.")]
    assert len(branch) > 10
    for name in branch:
        assert torch.equal(before[name], after[name]), name
    model = load_model(tmp_path / "checkpoints" / "last.ckpt")
    for name, value in model.encoder.semantic.named_parameters():
        assert torch.equal(value, before[f"model.encoder.semantic.{name}"]), name
        assert not value.requires_grad
    config = json.loads((tmp_path / "metrics.json").read_text())["provenance"]["config"]
    variant = model_variant(config, "metrics.json")
    assert variant.has_semantics
    assert variant.encoder.endswith("semantic branch")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            ["encoder.semantic=null"],
            "encoder.semantic: expected the options of a branch to train; found None",
        ),
        ([BRANCH, "data.size=50"], "data.size: expected sides divisible by the patch size 14"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(data, tmp_path, capsys, overrides, message):
    """A wrong setting must be named."""
    steps = ["trainer.max_steps=1", "logger=none", "callbacks=none"]
    assert ghgs("pretext", *data, *steps, *overrides, f"hydra.run.dir={tmp_path}") == 1
    assert message in capsys.readouterr().err
