"""Ablations of a user's own: rows by the option that was chosen,
never one row for two configurations."""

import csv
import itertools
import json
from pathlib import Path

import pytest

from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables import to_csv, to_latex, to_markdown
from tests.helpers.models import TINY
from tests.helpers.tables import SWITCHES, body, config_of, start_run, tables_of, write_run
from tests.helpers.verbs import ghgs


def chosen(ablation: str, **sets) -> dict:
    keys = {key.replace("__", "."): value for key, value in sets.items()}
    return {"model": "paper", "encoder": "vggt_nano", "ablation": ablation, "sets": keys}


def with_neighbors(k: int | float, row: str = "full") -> dict:
    return {**config_of(row)["recalibration"], "k": k}


def rows_of(folder: Path, **options) -> dict[str, list[str]]:
    """Cells of the table by the texts of the first columns."""
    (table,) = tables_of(folder, **{"metrics": ("psnr",), "views": (4,), **options})
    lines = [line.strip("|").split("|") for line in to_markdown(table).splitlines() if line[:1] == "|"]
    cells = [[cell.strip().strip("*") for cell in line] for line in lines[2:]]
    width = len(table.stub)
    return {" ".join(row[:width]).replace(" (a)", ""): row[width:] for row in cells}


def test_an_ablation_of_ones_own_is_trained_evaluated_and_printed(tmp_path, boxes, monkeypatch, capsys):
    """From a YAML file outside of the package to the row of its name."""
    monkeypatch.chdir(tmp_path)
    file = Path("conf/ablation/one_neighbor.yaml")
    file.parent.mkdir(parents=True)
    file.write_text("# @package _global_\nrecalibration: {k: 1}\n")
    common = ["--config-dir", "conf", "views=v3", "evaluation.targets=[midway]", "evaluation.pictures=0"]
    small = [override for override in TINY if not override.startswith("recalibration.k=")]
    data = ["data=scans", f"data.root={boxes}", "data.size=28"]
    quick = ["model=paper", "trainer.max_steps=2", "logger=none", "callbacks=none"]
    grid = ["-m", "ablation=full,one_neighbor", "hydra.sweep.dir=sweep"]
    assert ghgs("train", *common, *data, *small, *quick, *grid) == 0
    names = {}
    for path in Path("sweep").glob("*/metrics.json"):
        provenance = json.loads(path.read_text())["provenance"]
        assert provenance["ablation"] == provenance["config"]["chosen"]["ablation"]
        names[provenance["ablation"]] = path.parent
    assert set(names) == {"full", "one_neighbor"}
    # Measured again: the checkpoint, not the command, says which ablation it is.
    run = [f"checkpoint={names['one_neighbor']}/checkpoints/last.ckpt", "hydra.run.dir=measured"]
    assert ghgs("evaluate", *common, *run) == 0
    measured = json.loads(Path("measured/metrics.json").read_text())
    assert measured["provenance"]["ablation"] == "one_neighbor"
    capsys.readouterr()
    table = ["evaluation.views=[3]", "columns=[psnr]", "hydra.run.dir=table"]
    for runs in ("sweep", "[sweep,measured]"):
        assert ghgs("table", f"runs={runs}", *table) == 0
        printed = capsys.readouterr().out
        lines = [line.split() for line in printed.splitlines() if line[:1].isalpha()]
        lines = [line[: -1 if line[-1] == "◂" else None] for line in lines]
        rows = {line[0]: line[-1] for line in lines if line[1:2] in (["✓"], ["✗"])}
        assert list(rows) == ["neither", "no_unprojection", "no_semantic", "full", "one_neighbor"]
        assert rows["neither"] == "-"
        psnr = [row["psnr"] for row in measured["rows"] if row["targets"] == "midway"]
        assert float(rows["one_neighbor"]) == pytest.approx(sum(psnr) / len(psnr), abs=0.006)
        assert rows["full"] != "-"
        assert "one_neighbor: recalibration.k=1." in printed
    # What the checkpoint was trained with cannot be said otherwise.
    assert ghgs("evaluate", *common, *run, "ablation=full") == 1
    assert "ablation: expected one_neighbor, as the checkpoint was trained" in capsys.readouterr().err


def test_own_rows_stand_below_the_papers_in_every_format(tmp_path):
    """Planned ones too; a table without any is that of the paper."""
    for name in SWITCHES:
        write_run(tmp_path / name, name, 20.0, chosen=chosen(name))
    assert " ".join(rows_of(tmp_path)) == "✗ ✗ ✗ ✓ ✓ ✗ ✓ ✓"
    mine = {"recalibration": with_neighbors(1), "chosen": chosen("mine", recalibration__k=1)}
    write_run(tmp_path / "mine", "full", 18.0, **mine)
    log = {**config_of("full")["recalibration"], "similarity": "log", "neighborhood": "feature"}
    start_run(tmp_path / "going", "full", recalibration=log, chosen=chosen("log"))
    rows = rows_of(tmp_path, layout="table4", reported=False)
    assert list(rows) == [
        "neither ✗ ✗", "no_unprojection ✗ ✓", "no_semantic ✓ ✗", "full ✓ ✓", "log ✗ ✓", "mine ✓ ✓",
    ]  # fmt: skip
    assert [rows[name] for name in ("full ✓ ✓", "mine ✓ ✓", "log ✗ ✓")] == [["24.00"], ["22.00"], ["missing"]]
    (table,) = tables_of(tmp_path, "table4")
    assert r"mine & \cmark{} & \cmark{} (a) & 22.00" in to_latex(table, "x")
    lines = list(csv.DictReader(to_csv([table]).splitlines()))
    found = {
        (row["ablation"], row["mean"]) for row in lines if (row["metric"], row["kind"]) == ("psnr", "model")
    }
    assert {("full", "24.0"), ("mine", "22.0"), ("log", "")} <= found
    (table,) = tables_of(tmp_path, "table3", reported=False, metrics=("psnr",))
    assert body(to_markdown(table))[0]["Ours (mine)"] == ["22.00"]
    # It says what the row is; what an ablation sets is not a difference by accident.
    assert "`mine`: `recalibration.k=1`." in table.notes
    assert not any("differ also" in note for note in table.notes)


@pytest.mark.parametrize("seed", [1, 2])
def test_two_configurations_never_share_a_row(tmp_path, seed):
    """Not as two seeds either, whatever the command line did to the option that was chosen."""
    write_run(tmp_path / "0", "full", 20.0, recalibration=with_neighbors(64), chosen=chosen("full"))
    changed = {"recalibration": with_neighbors(1), "chosen": chosen("full")}
    write_run(tmp_path / "1", "full", 20.0 + seed - 1, seed, **changed)
    if seed == 1:  # the same numbers: of one configuration they would be one run
        write_run(tmp_path / "1", "full", 20.5, seed, **changed)
    with pytest.raises(
        InputError, match=r"ablation=full, .*recalibration.k` \(64, 1\): by=\[recalibration.k\]"
    ):
        rows_of(tmp_path)
    tables = tables_of(tmp_path, by=["recalibration.k"])
    assert len(tables) == 2


def test_equal_configurations_share_a_row_whatever_they_are_called(tmp_path):
    """A seed each: of the paper's name, of an own one, and of the command line alone."""
    one = {"recalibration": with_neighbors(1)}
    for (seed, name), folder in zip(
        [(1, "mine"), (2, "full"), (3, "other")], itertools.count(), strict=False
    ):
        write_run(tmp_path / str(folder), "full", 20.0 + seed, seed, **one, chosen=chosen(name))
    assert rows_of(tmp_path)["✓ ✓"] == ["26.00 ± 1.00"]


def test_results_of_an_earlier_version_are_read_by_what_they_say(tmp_path):
    """Their options stand beside the configuration, not in it; without any, the switches tell."""
    path = write_run(tmp_path / "0", "full", 20.0, recalibration=with_neighbors(1))
    content = json.loads(path.read_text())
    content["provenance"] |= {"verb": "train", "choices": {"ablation": "mine", "model": "paper"}}
    path.write_text(json.dumps(content))
    path.with_name("config.yaml").unlink()
    write_run(tmp_path / "1", "full", 21.0, recalibration=with_neighbors(64))
    rows = rows_of(tmp_path)
    assert (rows["mine ✓ ✓"], rows["full ✓ ✓"]) == (["24.00"], ["25.00"])


def test_a_model_of_ones_own_has_a_row_though_it_kept_the_name(tmp_path):
    """Its YAML begins with `defaults: [hull]`, and hull's file names the model."""
    for number, name in enumerate(("hull", "mine")):
        options = {**chosen("full"), "model": name}
        write_run(tmp_path / name, "full", 20.0 + number, model={"name": "hull"}, chosen=options)
    rows = rows_of(tmp_path, layout="table3", reported=False)
    assert rows == {"Ours (hull)": ["24.00"], "Ours (mine)": ["25.00"]}
