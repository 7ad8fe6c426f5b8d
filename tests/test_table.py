"""The ablation table out of fabricated runs."""

import json

import pytest

from ghgs_lit.errors import InputError
from ghgs_lit.experiments.results import read_results, summarize, write_results
from ghgs_lit.experiments.table import (
    FOOTNOTE,
    ILLUSTRATION,
    NO_SEMANTICS,
    caption,
    collect,
    deviation,
    to_csv,
    to_markdown,
)

SWITCHES = {
    "full": (True, True),
    "no_unprojection": (False, True),
    "no_semantic": (True, False),
    "neither": (False, False),
}


def write_run(folder, ablation, psnr, seed=1, views=(3, 4, 5), targets="release", lpips=None, weights=None):
    """A run of two subjects whose mean PSNR at n views is ``psnr + n``."""
    unprojection, semantic = SWITCHES[ablation]
    config = {
        "ablation": {"name": ablation, "unprojection": unprojection, "semantic": semantic},
        "model": {"name": "paper"},
        "encoder": {"weights": weights},
        "seed": seed,
    }
    rows = [
        {
            "method": "model", "subject": subject, "views": n, "targets": targets, "target": "000/3",
            "inputs": ["000/0"], "psnr": psnr + n + shift, "ssim": 0.9, "flip": 0.1,
            **({} if lpips is None else {"lpips": lpips}),
        }
        for n in views
        for subject, shift in (("a", -1.0), ("b", 1.0))
    ]  # fmt: skip
    source = {
        "config": config,
        "seed": seed,
        "data": {"name": "synthetic", "split": "val"},
        "protocol": {"metrics": "correct"},
        "choices": {"encoder": "vggt_nano"},
    }
    return write_results(folder, rows, source)


def body(markdown):
    """The table's rows by their first two cells, without marks for notes."""
    lines = [
        [c.strip() for c in line.strip("|").split("|")] for line in markdown.splitlines() if line[:1] == "|"
    ]
    return {(row[0], row[1][:1]): row[2:] for row in lines[2:]}, lines[0]


def test_rows_columns_best_and_missing(tmp_path):
    write_run(tmp_path / "0", "full", 20.0)
    write_run(tmp_path / "1" / "deep", "no_semantic", 21.0, views=(4,))
    write_run(tmp_path / "2", "no_unprojection", 19.0)
    (table,) = collect(tmp_path)
    rows, header = body(to_markdown(table, [3, 4, 5]))
    assert header[2:5] == ["3-view PSNR ↑", "3-view SSIM ↑", "3-view FLIP ↓"]
    assert header[5] == "4-view PSNR ↑"
    assert list(rows) == [("✗", "✗"), ("✗", "✓"), ("✓", "✗"), ("✓", "✓")]
    assert rows["✗", "✗"] == ["missing"] * 9
    assert rows["✓", "✓"][0] == "**23.00**"
    assert rows["✓", "✓"][3] == "24.00"
    assert rows["✓", "✗"] == ["missing"] * 3 + ["**25.00**", "0.9000", "0.1000"] + ["missing"] * 3
    assert rows["✗", "✓"][6] == "24.00"
    # Equal numbers are not the best of anything.
    assert rows["✓", "✓"][1] == "0.9000"


def test_several_seeds_give_a_deviation(tmp_path):
    for seed, psnr in ((1, 20.0), (2, 21.0), (3, 22.0)):
        write_run(tmp_path / str(seed), "full", psnr, seed=seed)
    (table,) = collect(tmp_path)
    rows, _ = body(to_markdown(table, [4]))
    assert rows["✓", "✓"][0] == "25.00 ± 1.00"
    assert "3 seeds" in caption(table)
    assert deviation([1.0]) is None


def test_lpips_is_shown_when_every_run_has_it(tmp_path):
    write_run(tmp_path / "0", "full", 20.0, lpips=0.05, weights="vggt.safetensors")
    (table,) = collect(tmp_path)
    text = to_markdown(table, [3])
    assert "3-view LPIPS ↓" in text
    assert "FLIP" not in text
    assert NO_SEMANTICS not in text
    write_run(tmp_path / "1", "neither", 20.0, weights="vggt.safetensors")
    (table,) = collect(tmp_path)
    assert "3-view FLIP ↓" in to_markdown(table, [3])


def test_notes_and_caption_say_what_the_numbers_are(tmp_path):
    write_run(tmp_path / "0", "full", 20.0)
    (table,) = collect(tmp_path)
    text = to_markdown(table, [3], illustration=True)
    for said in (FOOTNOTE, NO_SEMANTICS, ILLUSTRATION, "`synthetic`", "2 subjects", "`release`", "`correct`"):
        assert said in text
    assert ILLUSTRATION not in to_markdown(table, [3])


def test_targets_are_tables_of_their_own_and_can_be_picked(tmp_path):
    write_run(tmp_path / "0", "full", 20.0)
    write_run(tmp_path / "1", "full", 18.0, targets="midway")
    assert [t.setting.targets for t in collect(tmp_path)] == ["release", "midway"]
    assert [t.setting.targets for t in collect(tmp_path, ["midway"])] == ["midway"]
    with pytest.raises(InputError, match="others only"):
        collect(tmp_path, ["random"])


def test_two_runs_of_one_cell_are_refused(tmp_path):
    write_run(tmp_path / "0", "full", 20.0)
    write_run(tmp_path / "1", "full", 21.0)
    with pytest.raises(InputError, match=r"ablation=full, 3 views, seed 1; found .*0/metrics\.json"):
        collect(tmp_path)


def test_csv_has_every_cell_in_full(tmp_path):
    write_run(tmp_path / "0", "full", 20.0 + 1 / 3, views=(3,))
    lines = to_csv(collect(tmp_path), [3, 4]).splitlines()
    assert len(lines) == 1 + 4 * 2 * 3
    (line,) = (line for line in lines if ",True,True,3,psnr," in line)
    assert float(line.split(",")[-2]) == pytest.approx(23 + 1 / 3, abs=1e-12)


def test_results_that_are_none_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        collect(tmp_path / "nowhere")
    with pytest.raises(InputError, match="none"):
        collect(tmp_path)
    path = tmp_path / "metrics.json"
    path.write_text("{")
    with pytest.raises(InputError, match=r"metrics\.json"):
        collect(tmp_path)
    path.write_text(json.dumps({"format_version": 99}))
    with pytest.raises(InputError, match="format_version 1; found 99"):
        read_results(path)
    with pytest.raises(InputError, match="at least one"):
        write_results(tmp_path, [], {})


def test_undefined_values_are_null_and_left_out_of_means(tmp_path):
    about = {"method": "model", "views": 3, "targets": "release", "target": "t", "inputs": ["a", "b"]}
    rows = [
        {**about, "subject": "a", "psnr": 20.0, "psnr_box": float("nan"), "depth_error_mm": None},
        {**about, "subject": "a", "psnr": 30.0, "psnr_box": 10.0, "depth_error_mm": None},
        {**about, "subject": "b", "psnr": 40.0, "psnr_box": float("inf"), "depth_error_mm": None},
    ]
    (means,) = summarize(rows[:2])
    assert means["psnr_box"] == 10
    assert means["depth_error_mm"] is None
    # Each subject counts once, however many targets it has.
    assert summarize(rows)[0]["psnr"] == pytest.approx((25 + 40) / 2)
    content = read_results(write_results(tmp_path, rows, {"seed": 1}))
    assert content["rows"][0]["psnr_box"] is None
    assert content["rows"][2]["psnr_box"] is None
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert lines[0] == "method,subject,views,targets,target,inputs,psnr,psnr_box,depth_error_mm"
    assert lines[1] == "model,a,3,release,t,a b,20.0,,"
    assert not list(tmp_path.glob(".*"))
