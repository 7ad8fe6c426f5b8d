"""``ghgs benchmark`` with tiny models: files, budgets, custom presets."""

import json

import pytest

from ghgs_lit.method.heads import dpt
from ghgs_lit.weights.checkpoint import write_checkpoint
from tests.helpers.models import TINY, config, make_model
from tests.helpers.people import render_boxes
from tests.helpers.verbs import ghgs

KEYS = {"preset", "stage", "seconds", "seconds_low", "seconds_high", "psnr"}
OF_TOTAL = {"peak_bytes", "flops", "max_rel_diff", "psnr_loss_db", "budget_db"}
QUICK = ["timing.repeats=1", "metrics.lpips=off", "views=v3"]
STAGES = [
    "bounds", "encoder.patch_tokens", "encoder", "depth_head", "unprojection", "recalibration",
    "gaussian_head", "render", "other", "total",
]  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "rendered", folder / "scans", train=1, val=2)
    return ["data=scans", f"data.root={folder / 'rendered'}", "data.size=42"]


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "tiny.ckpt"
    write_checkpoint(path, make_model().state_dict(), config())
    return f"checkpoint={path}"


def benchmark(directory, *arguments):
    """Exit code, content of the JSON file, and its rows of whole cases by preset."""
    code = ghgs("benchmark", *QUICK, "subjects=1", *arguments, f"hydra.run.dir={directory}")
    content = json.loads((directory / "benchmark.json").read_text())
    return code, content, {row["preset"]: row for row in content["rows"] if row["stage"] == "total"}


def test_the_files_have_one_row_for_each_preset_and_stage(data, tmp_path):
    """Scripts read these keys. ``none`` is always measured, since others are compared with it."""
    code, content, whole = benchmark(tmp_path, *data, *TINY, "presets=[exact,balanced]", "subjects=2")
    assert code == 0
    assert {"processor", "vectors", "cores", "threads", "torch"} <= set(content["machine"])
    presets = ["none", "exact", "balanced"]
    rows = content["rows"]
    assert [(row["preset"], row["stage"]) for row in rows] == [(p, s) for p in presets for s in STAGES]
    for row in rows:
        assert set(row) >= KEYS
        assert row["seconds"] >= 0
        assert (row["psnr"] is not None) == (row["stage"] == "total"), row
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
    text = (tmp_path / "benchmark.md").read_text()
    assert "| balanced |" in text
    assert "Machine: " in text
    assert (tmp_path / "config.yaml").exists()


@pytest.mark.parametrize("model", ["hull", "recurrent"])
def test_a_halo_that_is_a_pixel_too_small_breaks_exact(model, data, tmp_path, monkeypatch, capsys):
    """Rounds amplify rounding by a factor that is measured, so that a defect stands out from it."""
    arguments = [*data, *TINY, f"model={model}", "presets=[exact]"]
    code, _, right = benchmark(tmp_path / "right", *arguments)
    assert code == 0
    enough = dpt.reach
    monkeypatch.setattr(dpt, "reach", lambda *layers: max(0, enough(*layers) - 1))
    code, _, wrong = benchmark(tmp_path / "wrong", *arguments)
    assert code == 1
    assert "exact: expected rel_diff up to max_rel_diff=1e-05; found" in capsys.readouterr().err
    assert 10 * right["exact"]["rel_diff"] <= 1e-5 <= wrong["exact"]["rel_diff"] / 10


def test_a_custom_preset_that_exceeds_its_budget_ends_with_code_1(data, tmp_path, capsys):
    """A file of ``conf/skip`` is a preset without any code, and its budget is checked."""
    mine = tmp_path / "conf" / "skip" / "mine.yaml"
    mine.parent.mkdir(parents=True)
    mine.write_text("defaults: [balanced, _self_]\nname: mine\nmax_rel_diff: 1.0e-9\nbudget_db: -100\n")
    arguments = [f"--config-dir={tmp_path / 'conf'}", *data, *TINY]
    assert benchmark(tmp_path / "a", *arguments, "presets=[mine]")[0] == 1
    out, err = capsys.readouterr()
    assert out.strip().splitlines()[-1] == f"wrote {tmp_path / 'a' / 'benchmark.json'}"
    # Random weights have no budget of PSNR.
    assert "mine: expected rel_diff up to max_rel_diff=1e-09; found" in err
    assert "dB" not in err
    assert ghgs("benchmark", *arguments, "presets=[mien]", f"hydra.run.dir={tmp_path / 'b'}") == 1
    assert "did you mean mine?" in capsys.readouterr().err


def test_a_checkpoint_with_presets_and_knobs(data, checkpoint, tmp_path, capsys):
    """Presets and knobs act on the model of a checkpoint; other options of the model are rejected."""
    knobs = "knobs={recalibration.k:[2],precision:[float32]}"
    code, content, whole = benchmark(tmp_path / "a", *data, checkpoint, "presets=[balanced]", knobs)
    assert code == 0
    changed = "balanced recalibration.k=2 precision=float32"
    assert set(whole) == {"none", "none recalibration.k=2 precision=float32", changed}
    assert not content["random_weights"]
    assert whole["none"]["trained"]
    assert whole[changed]["budget_db"] is None
    assert whole[changed]["max_rel_diff"] > 0
    assert whole[changed]["tokens"] < whole["none"]["tokens"]
    given = [*data, checkpoint, "recalibration.k=2"]
    assert ghgs("benchmark", *given, f"hydra.run.dir={tmp_path / 'b'}") == 1
    assert "recalibration.k: expected no option of the model" in capsys.readouterr().err


@pytest.mark.parametrize(("budget", "code"), [([], 0), (["skip.budget_db=-1"], 1)])
def test_a_trained_model_keeps_its_budget_of_psnr(budget, code, data, checkpoint, tmp_path, capsys):
    """The loss of PSNR is checked with a checkpoint, against the budget of the command line."""
    assert benchmark(tmp_path, *data, checkpoint, "presets=[exact]", *budget)[0] == code
    assert ("exact: expected a loss up to -1 dB of PSNR; found" in capsys.readouterr().err) == bool(code)


@pytest.mark.parametrize(
    ("wrong", "key"),
    [
        ("timing.repeats=0", "timing.repeats"),
        ("presets=[]", "presets"),
        ("presets=exact", "presets"),
        ("subjects=0", "subjects"),
        ("knobs={recalibration.colour:[1]}", "knobs.recalibration.colour"),
    ],
)
def test_impossible_settings_are_named(wrong, key, data, tmp_path, capsys):
    """A mistake is reported before anything is measured."""
    assert ghgs("benchmark", *data, *TINY, *QUICK, wrong, f"hydra.run.dir={tmp_path}") == 1
    assert f"ghgs benchmark: {key}: expected" in capsys.readouterr().err
