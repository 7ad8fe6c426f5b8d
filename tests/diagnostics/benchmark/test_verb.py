"""``ghgs benchmark`` from end to end with tiny models: files, budgets, presets without code."""

import json

import pytest

from ghgs_lit.method.heads import dpt
from ghgs_lit.weights.checkpoint import write_checkpoint
from tests.helpers.models import TINY, config, make_model
from tests.helpers.people import render_boxes
from tests.helpers.verbs import ghgs

KEYS = {"preset", "stage", "seconds", "seconds_low", "seconds_high", "psnr"}
OF_TOTAL = {"peak_bytes", "flops", "max_rel_diff", "psnr_loss_db", "budget_db"}
QUICK = ["timing.repeats=1", "threads=1", "metrics.lpips=off", "views=v3"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "rendered", folder / "scans", train=1, val=2)
    return ["data=scans", f"data.root={folder / 'rendered'}", "data.size=42"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "tiny.ckpt"
    write_checkpoint(path, make_model().state_dict(), config())
    return path


def totals(content):
    return {row["preset"]: row for row in content["rows"] if row["stage"] == "total"}


@pytest.fixture(scope="module")
def measured(data, tmp_path_factory):
    directory = tmp_path_factory.mktemp("benchmark") / "run"
    code = ghgs(
        "benchmark", *data, *TINY, *QUICK, "presets=[exact,balanced]", "subjects=2",
        f"hydra.run.dir={directory}",
    )  # fmt: skip
    assert code == 0
    return directory


def test_the_json_has_one_row_for_each_preset_and_stage(measured):
    """Scripts read these keys; ``none`` is measured because the others are compared with it."""
    content = json.loads((measured / "benchmark.json").read_text())
    assert {"processor", "vectors", "cores", "threads", "torch"} <= set(content["machine"])
    assert all(set(row) >= KEYS for row in content["rows"])
    stages = [
        "bounds", "encoder.patch_tokens", "encoder", "depth_head", "unprojection", "recalibration",
        "gaussian_head", "render", "other", "total",
    ]  # fmt: skip
    for preset in ("none", "exact", "balanced"):
        assert [row["stage"] for row in content["rows"] if row["preset"] == preset] == stages, preset
    assert len(content["rows"]) == 3 * len(stages)
    for row in content["rows"]:
        assert row["seconds"] >= 0
        assert (row["psnr"] is not None) == (row["stage"] == "total"), row
    whole = totals(content)
    assert list(whole) == ["none", "exact", "balanced"]
    assert all(set(row) >= OF_TOTAL for row in whole.values())
    assert whole["none"]["max_rel_diff"] == whole["none"]["psnr_loss_db"] == 0
    assert whole["exact"]["budget_db"] is not None
    assert whole["balanced"]["tokens"] < whole["exact"]["tokens"] == 27
    assert whole["exact"]["gaussians"] == whole["exact"]["points"] > 0
    assert whole["balanced"]["flops"] < whole["exact"]["flops"] < whole["none"]["flops"]
    assert content["random_weights"]
    assert content["broken"] == []
    assert len(content["subjects"]) == 3 * 2
    assert content["provenance"]["verb"] == "benchmark"


@pytest.mark.parametrize("model", ["hull", "recurrent"])
def test_a_halo_that_is_a_pixel_too_small_breaks_exact(model, data, tmp_path, monkeypatch, capsys):
    """Rounds amplify rounding by a factor that is measured, so that a defect stands out from it."""
    arguments = [*data, *TINY, *QUICK, f"model={model}", "presets=[exact]", "subjects=1"]
    assert ghgs("benchmark", *arguments, f"hydra.run.dir={tmp_path / 'right'}") == 0
    enough = dpt.reach
    monkeypatch.setattr(dpt, "reach", lambda *layers: max(0, enough(*layers) - 1))
    assert ghgs("benchmark", *arguments, f"hydra.run.dir={tmp_path / 'wrong'}") == 1
    assert "exact: expected rel_diff up to max_rel_diff=1e-05; found" in capsys.readouterr().err
    right, wrong = (
        totals(json.loads((tmp_path / name / "benchmark.json").read_text()))["exact"]
        for name in ("right", "wrong")
    )
    assert 10 * right["rel_diff"] <= 1e-5 <= wrong["rel_diff"] / 10


def test_all_files_of_a_benchmark_are_written(measured):
    """One page of tables, one file of numbers, and the configuration."""
    text = (measured / "benchmark.md").read_text()
    assert "| balanced |" in text
    assert "Machine: " in text
    files = {path.name for path in measured.iterdir() if not path.name.startswith(".")}
    assert files >= {"benchmark.json", "benchmark.md", "config.yaml"}
    assert not files & {"benchmark.csv", "benchmark.html", "tensorboard"}


def test_a_preset_of_the_user_that_breaks_its_budget_ends_with_code_1(data, tmp_path, capsys):
    """A new file of ``conf/skip`` is a preset without any code, and its promise is checked."""
    mine = tmp_path / "conf" / "skip" / "mine.yaml"
    mine.parent.mkdir(parents=True)
    mine.write_text("defaults: [balanced, _self_]\nname: mine\nmax_rel_diff: 1.0e-9\nbudget_db: -100\n")
    run = ["benchmark", f"--config-dir={tmp_path / 'conf'}", *data, *TINY, *QUICK, "subjects=1"]
    assert ghgs(*run, "presets=[mine]", f"hydra.run.dir={tmp_path / 'a'}") == 1
    out, err = capsys.readouterr()
    assert out.strip().splitlines()[-1] == f"wrote {tmp_path / 'a' / 'benchmark.json'}"
    # Nobody trained these weights: a loss of PSNR is no broken promise.
    assert "mine: expected rel_diff up to max_rel_diff=1e-09; found" in err
    assert "dB" not in err
    assert ghgs(*run, "presets=[mien]", f"hydra.run.dir={tmp_path / 'b'}") == 1
    assert "did you mean mine?" in capsys.readouterr().err


def test_a_checkpoint_in_every_preset(data, checkpoint, tmp_path, capsys):
    """Presets act on the weights of a checkpoint, whose configuration has those of its training."""
    run = ["benchmark", *data, *QUICK, f"checkpoint={checkpoint}", "subjects=1"]
    code = ghgs(
        *run, "presets=[balanced]", "knobs={recalibration.k:[2],precision:[float32]}",
        f"hydra.run.dir={tmp_path / 'a'}",
    )  # fmt: skip
    content = json.loads((tmp_path / "a" / "benchmark.json").read_text())
    whole = totals(content)
    changed = "balanced recalibration.k=2 precision=float32"
    assert set(whole) == {
        "none", "none recalibration.k=2 precision=float32", changed,
    }  # fmt: skip
    assert not content["random_weights"]
    assert whole["none"]["trained"]
    assert whole[changed]["budget_db"] is None
    assert whole[changed]["max_rel_diff"] > 0
    assert whole[changed]["tokens"] < whole["none"]["tokens"]
    assert code == 0
    # What the checkpoint decides is not ignored in silence.
    assert ghgs(*run, "recalibration.k=2", f"hydra.run.dir={tmp_path / 'b'}") == 1
    assert "recalibration.k: expected no option of the model" in capsys.readouterr().err


def test_a_trained_model_keeps_its_budget_of_psnr(data, checkpoint, tmp_path, capsys):
    """With a checkpoint the loss of PSNR is checked, for the values that the command line gives."""
    run = ["benchmark", *data, *QUICK, f"checkpoint={checkpoint}", "subjects=1", "presets=[exact]"]
    assert ghgs(*run, f"hydra.run.dir={tmp_path / 'a'}") == 0
    capsys.readouterr()
    assert ghgs(*run, "skip.budget_db=-1", f"hydra.run.dir={tmp_path / 'b'}") == 1
    assert "exact: expected a loss up to -1 dB of PSNR; found" in capsys.readouterr().err


def test_impossible_settings_are_named(data, tmp_path, capsys):
    """Mistakes cost a line, not the time of a benchmark."""
    for wrong, said in {
        "timing.repeats=0": "timing.repeats",
        "presets=[]": "presets",
        "presets=exact": "presets",
        "subjects=0": "subjects",
        "knobs={recalibration.colour:[1]}": "knobs.recalibration.colour",
    }.items():
        code = ghgs("benchmark", *data, *TINY, *QUICK, wrong, f"hydra.run.dir={tmp_path / 'run'}")
        assert code == 1
        assert f"ghgs benchmark: {said}: expected" in capsys.readouterr().err
