"""The ablation table of invented runs: rows, columns, best, seeds, missing and refused runs."""

import csv
import io
import json
import re

import pytest

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables import read_sweep, to_csv, to_latex, to_markdown, to_terminal
from ghgs_lit.evaluation.tables.notes import FOOTNOTE, NO_SEMANTICS
from ghgs_lit.runs.results import read_results, summarize, write_results
from tests.helpers.tables import body, start_run, tables_of, write_run


def test_rows_columns_best_and_missing(tmp_path):
    """All combinations and numbers of views appear; missing are planned ones alone, and only a real
    best is bold."""
    write_run(tmp_path / "0", "full", 20.0)
    write_run(tmp_path / "1" / "deep", "no_semantic", 21.0, views=(4,))
    write_run(tmp_path / "2", "no_unprojection", 19.0)
    start_run(tmp_path / "3", "no_semantic", 2, evaluation={"views": [5]})
    (table,) = tables_of(tmp_path)
    rows, header = body(to_markdown(table))
    assert header[2:5] == ["3-view PSNR ↑", "3-view SSIM ↑", "3-view FLIP ↓"]
    assert header[5] == "4-view PSNR ↑"
    assert list(rows) == [("✗", "✗"), ("✗", "✓"), ("✓", "✗"), ("✓", "✓")]
    assert rows["✗", "✗"] == ["-"] * 9
    assert rows["✓", "✓"][0] == "**23.00**"
    assert rows["✓", "✓"][3] == "24.00"
    assert rows["✓", "✗"] == ["-"] * 3 + ["**25.00**", "0.9000", "0.1000"] + ["missing"] * 3
    assert rows["✗", "✓"][6] == "24.00"
    # Equal numbers are not the best of anything.
    assert rows["✓", "✓"][1] == "0.9000"


def test_several_seeds_give_a_deviation(tmp_path):
    """Seeds are averaged and their sample deviation is printed."""
    for seed, psnr in ((1, 20.0), (2, 21.0), (3, 22.0)):
        write_run(tmp_path / str(seed), "full", psnr, seed=seed)
    (table,) = tables_of(tmp_path, views=(4,))
    rows, _ = body(to_markdown(table))
    assert rows["✓", "✓"][0] == "25.00 ± 1.00"
    assert "3 seeds" in table.caption


@pytest.mark.parametrize(("lead", "is_bold"), [(0.9, False), (1.2, True)])
def test_only_a_lead_beyond_the_deviation_is_bold(tmp_path, lead, is_bold):
    """Other seeds would have put the rows in another order."""
    for seed, shift in ((1, -1.0), (2, 0.0), (3, 1.0)):
        write_run(tmp_path / f"a{seed}", "full", 20.0 + shift + lead, seed=seed)
        write_run(tmp_path / f"b{seed}", "neither", 20.0 + shift / 4, seed=seed)
        write_run(tmp_path / f"c{seed}", "no_semantic", 10.0 + 5 * shift, seed=seed)
    (table,) = tables_of(tmp_path, views=(4,), metrics=("psnr",))
    assert [i for (i, *_), best in table.cells["best"].items() if best] == [3] * is_bold
    assert "in bold where it leads by more than the deviation" in table.caption


def test_a_lower_metric_is_better_and_any_metric_can_be_a_column(tmp_path):
    """The best LPIPS is the lowest, and columns can be chosen."""
    write_run(tmp_path / "0", "full", 20.0, lpips=0.05)
    write_run(tmp_path / "1", "neither", 20.0, lpips=0.06)
    (table,) = tables_of(tmp_path, views=(3,), metrics=("lpips", "flip"))
    rows, header = body(to_markdown(table))
    assert header[2:] == ["3-view LPIPS ↓", "3-view FLIP ↓"]
    assert rows["✓", "✓"] == ["**0.0500**", "0.1000"]
    assert rows["✗", "✗"] == ["0.0600", "0.1000"]


def test_runs_that_are_planned_or_going_are_said(tmp_path):
    """Incomplete sweeps say which runs and seeds are missing."""
    for seed in (1, 2):
        write_run(tmp_path / f"full{seed}", "full", 20.0 + seed, seed=seed)
    write_run(tmp_path / "other", "neither", 20.0, seed=1)
    start_run(tmp_path / "going", "neither", seed=2)
    start_run(tmp_path / "planned", "full", seed=3)
    # Half-written, and foreign: neither is a run.
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "config.yaml").write_text("ablation: {name: [")
    (table,) = tables_of(tmp_path, views=(4,))
    rows, _ = body(to_markdown(table))
    assert rows["✓", "✓"][0] == "**25.50 ± 0.71 (2/3)**"
    # No run of it with seed 3 is planned.
    assert rows["✗", "✗"][0] == "24.00 (1/2)"
    assert any("different seeds (✗ ✗: 1; ✓ ✓ (a): 1, 2)" in note for note in table.notes)
    assert any("synthetic paper neither seed 2" in note for note in table.notes)
    assert not any("seed 1" in note for note in table.notes)


def test_a_row_is_told_by_what_was_trained(tmp_path):
    """The configuration of `ghgs evaluate` says nothing about the model in its checkpoint."""
    write_run(tmp_path / "evaluated", "no_semantic", 20.0, seed=7, verb="evaluate")
    (table,) = tables_of(tmp_path, views=(4,))
    rows, _ = body(to_markdown(table))
    assert rows["✓", "✗"][0] == "24.00"
    assert rows["✗", "✗"][0] == "-"


def test_lpips_is_shown_when_every_run_has_it(tmp_path):
    """A column never mixes runs with and without LPIPS."""
    write_run(tmp_path / "0", "full", 20.0, lpips=0.05, weights="vggt.safetensors")
    (table,) = tables_of(tmp_path, views=(3,))
    text = to_markdown(table)
    assert "3-view LPIPS ↓" in text
    assert "FLIP" not in text
    assert NO_SEMANTICS not in text
    write_run(tmp_path / "1", "neither", 20.0, weights="vggt.safetensors")
    (table,) = tables_of(tmp_path, views=(3,))
    assert "3-view FLIP ↓" in to_markdown(table)


@pytest.mark.parametrize(("weights", "semantic"), [("pretext", True), (None, False)])
def test_a_branch_that_has_learned_parts_needs_no_footnote(tmp_path, weights, semantic):
    """A random branch (`allow_random_encoder`) carries no more than any other random features."""
    encoder = {"semantic": {"width": 64}, "weights": weights}
    write_run(tmp_path / "0", "full", 20.0, encoder=encoder)
    (table,) = tables_of(tmp_path, views=(3,))
    assert (NO_SEMANTICS not in to_markdown(table)) is semantic


def test_notes_and_caption_say_what_the_numbers_are(tmp_path):
    """Readers see data, protocol, code states and settings that differ."""
    write_run(tmp_path / "0", "full", 20.0, git={"commit": "a" * 40, "changed": False})
    (table,) = tables_of(tmp_path)
    text = to_markdown(table)
    for said in (FOOTNOTE, NO_SEMANTICS, "`synthetic`", "2 subjects", "`release`", "`correct`"):
        assert said in text
    assert "states of the code" not in text
    write_run(
        tmp_path / "1", "neither", 20.0, git={"commit": "b" * 40, "changed": True}, optimizer={"lr": 0.1}
    )
    (table,) = tables_of(tmp_path)
    text = to_markdown(table)
    # What a reviewer would ask: is it the same code and the same training?
    assert "2 states of the code: aaaaaaaaa, bbbbbbbbb with changes" in text
    assert "differ also in `optimizer.lr` (absent, 0.1)" in text


def test_targets_are_tables_of_their_own_and_can_be_picked(tmp_path):
    """Numbers on different targets or metrics never share a table."""
    write_run(tmp_path / "0", "full", 20.0)
    write_run(tmp_path / "1", "full", 18.0, targets="midway")
    write_run(tmp_path / "2", "full", 18.0, protocol="release")
    settings = [tuple(t.rows[["targets", "protocol"]].iloc[0]) for t in tables_of(tmp_path)]
    assert settings == [
        ("release", "correct"),
        ("midway", "correct"),
        ("release", "release"),
    ]
    (table,) = tables_of(tmp_path, targets=("midway",))
    assert "targets `midway`" in table.caption
    with pytest.raises(InputError, match=r"expected some of release, midway, .*; found random"):
        tables_of(tmp_path, targets=("random",))


def test_two_runs_of_one_cell_are_refused_and_can_be_told_apart(tmp_path):
    """No run is averaged with another by accident; the message says how to separate them."""
    write_run(tmp_path / "0", "full", 20.0, optimizer={"lr": 0.1})
    write_run(tmp_path / "1", "full", 21.0, optimizer={"lr": 0.2})
    expected = (
        r"ablation=full, 3 views, seed 1; found .*0/metrics\.json and .*1/metrics.json.*by=\[optimizer\.lr\]"
    )
    with pytest.raises(InputError, match=expected):
        tables_of(tmp_path)
    first, second = tables_of(tmp_path, by=["optimizer.lr"])
    assert "optimizer.lr=0.1" in first.caption
    assert "optimizer.lr=0.2" in second.caption


def test_the_same_numbers_twice_are_one_run(tmp_path):
    """A run that was copied or evaluated again is not a second seed."""
    write_run(tmp_path / "0", "full", 20.0)
    write_run(tmp_path / "1", "full", 20.0, verb="evaluate")
    (table,) = tables_of(tmp_path)
    assert list(table.measured["seeds"]) == [(1,)] * 9


def test_csv_has_every_cell_in_full(tmp_path):
    """The CSV has all digits, and a row for every missing cell."""
    path = write_run(tmp_path / "0", "full", 20.0 + 1 / 3, views=(3,))
    own = json.loads(path.read_text())["provenance"]["config_hash"]
    rows = list(csv.DictReader(io.StringIO(to_csv(tables_of(tmp_path, views=(3, 4))))))
    assert len(rows) == 4 * 2 * 3
    (row,) = (r for r in rows if (r["ablation"], r["views"], r["metric"]) == ("full", "3", "psnr"))
    assert float(row["mean"]) == pytest.approx(23 + 1 / 3, abs=1e-12)
    assert (row["seeds"], row["subjects"], row["runs"], row["deviation"]) == ("1", "2", own, "")
    assert sum(r["mean"] == "" for r in rows) == 24 - 3


def test_a_table_of_some_subjects_says_of_which(tmp_path):
    """Nothing but the smaller number of subjects told it from the table of all."""
    write_run(tmp_path / "0", "full", 20.0, shifts={"a_1": 0.0, "a_2": 2.0, "b_1": 7.0})
    (whole,) = tables_of(tmp_path)
    assert "3 subjects of `val`, targets" in whole.caption
    assert {row["selection"] for row in csv.DictReader(io.StringIO(to_csv([whole])))} == {""}
    (two,) = tables_of(tmp_path, subjects=re.compile("a_."))
    assert "2 subjects of `val` whose names match `a_.`," in to_markdown(two)
    (one,) = tables_of(tmp_path, subjects=re.compile("b.*"))
    assert "1 subject of val whose name matches b.*," in to_terminal(one)
    assert r"1 subject of \texttt{val} whose name matches \texttt{b.*}," in to_latex(one, "label")
    assert one.cells["mean"].max() == 20.0 + 5 + 7
    rows = list(csv.DictReader(io.StringIO(to_csv([two, one]))))
    assert {row["selection"] for row in rows if row["mean"]} == {"a_.", "b.*"}
    with pytest.raises(InputError, match=r"subjects: expected .* of the runs, such as a_1; found 'a'"):
        tables_of(tmp_path, subjects=re.compile("a"))


def test_targets_that_nobody_measured_are_answered_with_those_that_were(tmp_path):
    write_run(tmp_path / "0", "full", 20.0)
    with pytest.raises(InputError, match=r"evaluation\.targets: expected some of release, .*; found midway"):
        tables_of(tmp_path, targets=("midway",))


def test_results_that_are_none_are_refused(tmp_path):
    """Missing, empty, damaged and newer results are errors with their path."""
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_sweep([tmp_path / "nowhere"])
    with pytest.raises(InputError, match="none"):
        read_sweep([tmp_path])
    start_run(tmp_path / "going", "full")
    with pytest.raises(InputError, match="1 runs without one"):
        read_sweep([tmp_path])
    path = tmp_path / "metrics.json"
    path.write_text("{")
    with pytest.raises(InputError, match=r"metrics\.json"):
        read_sweep([tmp_path])
    path.write_text(json.dumps({"format_version": 2}))
    with pytest.raises(InputError, match=r"format_version 3; found 2 .*evaluate"):
        read_results(path)
    path.write_text(json.dumps({"format_version": 99}))
    with pytest.raises(InputError, match="format_version 3; found 99"):
        read_results(path)
    with pytest.raises(InputError, match="at least one"):
        write_results(tmp_path, [], {})


def test_undefined_values_are_null_and_left_out_of_means(tmp_path):
    """nan and infinity never reach JSON or a mean, and each subject counts once."""
    about = {"method": "model", "views": 3, "targets": "release", "target": "t", "inputs": ["a", "b"]}
    rows = [
        {**about, "subject": "a", "psnr": 20.0, "psnr_box": float("nan"), "depth_error_mm": None},
        {**about, "subject": "a", "psnr": 30.0, "psnr_box": 10.0, "depth_error_mm": None},
        {**about, "subject": "b", "psnr": 40.0, "psnr_box": float("inf"), "depth_error_mm": None},
    ]
    rows.insert(2, {**about, "subject": "a", "psnr": 34.0, "psnr_box": float("nan"), "depth_error_mm": None})
    (means,) = summarize(rows[:3])
    assert means["psnr_box"] == 10
    assert means["depth_error_mm"] is None
    # Each subject counts once, however many targets it has.
    (means,) = summarize(rows)
    assert (means["psnr"], means["subjects"]) == ((28 + 40) / 2, 2)
    content = read_results(write_results(tmp_path, rows, {"seed": 1}))
    assert content["rows"][0]["psnr_box"] is None
    assert content["rows"][3]["psnr_box"] is None
    lines = (tmp_path / "metrics.csv").read_text().splitlines()
    assert lines[0].startswith("method,subject,views,targets,target,inputs,psnr,psnr_box,depth_error_mm")
    assert lines[1].startswith("model,a,3,release,t,a b,20.0,,")
    assert not list(tmp_path.glob(".*"))


def test_a_table_fits_a_terminal(tmp_path):
    """Each number of views has a line of its own, also with marks and missing seeds."""
    for ablation, psnr in (("full", 20.0), ("neither", 18.0)):
        for seed in (1, 2):
            write_run(tmp_path / f"{ablation}{seed}", ablation, psnr + seed / 10, seed=seed)
    start_run(tmp_path / "going", "neither", seed=3)
    text = to_terminal(tables_of(tmp_path)[0])
    lines = text.splitlines()
    shown = [line for line in lines if line.startswith(("✗", "✓"))]
    assert len(shown) == 4 * 3
    assert sum("(2/3)" in line for line in shown) == 3
    assert max(map(len, shown)) <= 120
    assert "23.15 ± 0.07 ◂ " in shown[-3]
    assert "best of the measured methods marked ◂ where" in text
    assert "**" not in text


def test_a_row_can_be_told_by_the_checkpoint_that_was_measured(tmp_path):
    """Keys of `ghgs evaluate` tell rows apart, too; keys that no run has are refused."""
    for name, psnr, seed in (("a.ckpt", 20.0, 1), ("b.ckpt", 21.0, 1), ("c.ckpt", 22.0, 2)):
        write_run(tmp_path / name, "full", psnr, seed, verb="evaluate", measured={"checkpoint": name})
    with pytest.raises(InputError, match=r"a.ckpt/metrics.json and .*b.ckpt/metrics.json.*by=\[checkpoint\]"):
        tables_of(tmp_path)
    (table,) = tables_of(tmp_path, "table2", by=["checkpoint"], reported=False)
    rows, _ = body(to_markdown(table))
    assert {name: row[0] for name, row in rows.items()} == {
        "Ours (checkpoint=a.ckpt)": "23.00",
        "Ours (checkpoint=b.ckpt)": "24.00",
        "Ours (checkpoint=c.ckpt)": "**25.00**",
    }
    # Each has the one seed that it was trained with: no run is lacking.
    assert not table.measured["lacking"].map(bool).any()
    assert not any("(2/3)" in note for note in table.notes)
    with pytest.raises(InputError, match="by: expected keys of the runs' configurations; found 'chekpoint'"):
        tables_of(tmp_path, "table2", by=["chekpoint"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"views": (7,)}, r"evaluation\.views: expected some of 3, 4, 5, with which .*; found .7"),
        ({"layout": "table3"}, "runs of layout=table3; found .baselines or the paper"),
    ],
)
def test_a_table_of_what_nobody_measured_is_refused(tmp_path, options, message):
    """No table of empty cells."""
    write_run(tmp_path / "0", "neither", 20.0)
    with pytest.raises(InputError, match=message):
        tables_of(tmp_path, **options)


def views(*counts, **changes) -> dict:
    return {"training_counts": list(counts), "training": "any", "evaluation_count": counts[0], **changes}


def test_each_column_is_of_the_model_that_was_trained_with_so_many_views(tmp_path):
    """Whatever else it was measured with. `by` gives each a row, as a model of several numbers has."""
    for number, (count, seed) in enumerate([(3, 1), (4, 2), (4, 1)]):
        run = tmp_path / str(number)
        write_run(run, "full", 20.0 + number, seed, views=(3, 4), nodes={"views": views(count)})
    start_run(tmp_path / "8", "full", 2, views=views(3), evaluation={"views": 3})
    start_run(tmp_path / "9", "full", 1, views=views(5), evaluation={"views": [5]})
    options = {"reported": False, "metrics": ("psnr",)}
    (table,) = tables_of(tmp_path, "table2", **options)
    assert body(to_markdown(table))[0] == {"Ours": ["23.00 (1/2)", "25.50 ± 0.71", "missing"]}
    assert any("trained with as many input views" in note for note in table.notes)
    assert not any("differ also" in note for note in table.notes)
    (table,) = tables_of(tmp_path, **options)
    assert body(to_markdown(table))[0]["✓", "✓"] == ["23.00 (1/2)", "25.50 ± 0.71", "missing"]
    write_run(tmp_path / "several", "full", 20.0, views=(3, 4), nodes={"views": views(3, 4)})
    (table,) = tables_of(tmp_path, "table2", **options)
    assert body(to_markdown(table))[0] == {
        "Ours (trained with as many views)": ["23.00 (1/2)", "**25.50 ± 0.71**", "missing"],
        "Ours (trained with 3, 4 views)": ["23.00", "24.00", "-"],
    }
    (table,) = tables_of(tmp_path, "table2", by=["views.training_counts"], **options)
    assert body(to_markdown(table))[0]["Ours (trained with 3 views)"] == ["23.00 (1/2)", "24.00", "-"]


@pytest.mark.parametrize("planned", [["c", "a", "b"], None])
def test_rows_stand_in_the_order_of_the_command_else_in_that_of_numbers(tmp_path, planned):
    """Folders are called by hashes."""
    for name, rate in (("a", 10), ("b", 9), ("c", 0.25)):
        write_run(tmp_path / name, "full", 20.0, optimizer={"lr": rate})
    if planned:
        (tmp_path / "multirun.yaml").write_text(f"seed: 1\nruns: {planned}\n")
    (table,) = tables_of(tmp_path, "table2", by=["optimizer.lr"], reported=False)
    rates = ["0.25", "10", "9"] if planned else ["0.25", "9", "10"]
    assert [line.stub for line in table.lines] == [(f"Ours (optimizer.lr={rate})",) for rate in rates]


@pytest.mark.parametrize(
    ("key", "values", "title"),
    [
        ("views.training", ["any", "even"], "input views in training: {}"),
        ("targets.training_views", [[0], [2, 3]], "target views in training: {}"),
        ("targets.per_step", [1, 2], "targets a step: {}"),
        ("targets.view", [2, 3], "target view {}"),
        ("targets.per_subject", [1, "all"], "targets a subject: {}"),
    ],
)
@pytest.mark.parametrize("seeds", [(1, 2), (1, 1)])
@pytest.mark.parametrize("verb", ["train", "evaluate"])
def test_other_views_and_targets_of_a_training_are_other_rows(tmp_path, key, values, title, seeds, verb):
    """They change the model, or what its protocol measures, as much as another learning rate."""
    group, _, name = key.partition(".")
    for number, value in enumerate(values):
        nodes = {"views": views(4), "targets": {"name": "release", "training_views": [2], "per_step": 3}}
        nodes["targets"] |= {"view": 3, "per_subject": 1}
        nodes[group][name] = value
        about = {"seed": seeds[number], "nodes": nodes, "measured": {"targets": nodes["targets"]}}
        write_run(tmp_path / str(number), "full", 20.0 + number, verb=verb, **about)
    (table,) = tables_of(tmp_path, "table2", reported=False, metrics=("psnr",))
    rows, _ = body(to_markdown(table))
    assert list(rows) == [f"Ours ({title.format(str(value).strip('[]'))})" for value in values]
    assert [row[0].strip("*") for row in rows.values()] == ["23.00", "24.00"]


def test_data_sets_with_other_targets_share_a_row(tmp_path):
    """Rings and static cameras have protocols of their own; the method is one."""
    for number, (data, name, numbers) in enumerate([("zju_mocap", "cameras", [0]), ("humman", "x", [2])]):
        targets = {"name": name, "training_views": numbers, "view": number}
        write_run(tmp_path / data, "full", 20.0, data=data, views=(4,), nodes={"targets": targets})
    (table,) = tables_of(tmp_path, "table1", reported=False, metrics=("psnr",))
    assert body(to_markdown(table))[0] == {"Ours": ["24.00", "24.00"]}


def test_a_refusal_says_that_configurations_are_equal(tmp_path):
    """Without a key that differs there is none to name."""
    for name, psnr in (("first", 20.0), ("again", 21.0)):
        write_run(tmp_path / name, "full", psnr)
    with pytest.raises(InputError, match="their configurations are equal; runs="):
        tables_of(tmp_path)
