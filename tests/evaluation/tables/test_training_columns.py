"""What the training took as columns, rows by what a model does, and results that were edited."""

import json

import pytest

from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.tables import read_sweep, to_markdown
from ghgs_lit.evaluation.tables.variants import encoder_name
from ghgs_lit.runs.provenance import config_hash
from tests.helpers.tables import body, tables_of, write_run

COLUMNS = ("psnr", "steps", "seconds", "peak_gb")


@pytest.mark.parametrize("name", ["vggt_nano", "vggt_small", "vggt_1b"])
def test_encoders_of_the_package_have_their_names(name):
    """A file says of the nested ``vit`` what differs from the file below it."""
    assert encoder_name(run_of("train", [f"encoder={name}"]).plain) == name


def test_steps_seconds_and_memory_can_be_columns(tmp_path):
    """A reader must see what each row cost; a run that does not say has no figure."""
    write_run(tmp_path / "0", "full", 20.0, training={"steps": 300, "seconds": 61.4, "peak_bytes": 2.5e9})
    write_run(tmp_path / "1", "neither", 19.0, training={"steps": 300, "seconds": 50.0})
    (table,) = tables_of(tmp_path, views=(4,), metrics=COLUMNS)
    rows, header = body(to_markdown(table))
    assert header[3:] == ["4-view Training steps", "4-view Training (s) ↓", "4-view Training memory (GB) ↓"]
    assert rows["✓", "✓"] == ["**24.00**", "300", "61", "2.5"]
    assert rows["✗", "✗"] == ["23.00", "300", "**50**", "-"]
    assert "different numbers of steps" not in to_markdown(table)


def test_rows_of_different_steps_are_said(tmp_path):
    """Rows of equal time but different steps do not show the method alone."""
    write_run(tmp_path / "0", "full", 20.0, training={"steps": 300, "seconds": 61.4})
    write_run(tmp_path / "1", "neither", 19.0, training={"steps": 350})
    write_run(tmp_path / "2", "neither", 19.0, seed=2, training={"steps": 360})
    (table,) = tables_of(tmp_path, views=(4,))
    said = "Rows were trained for different numbers of steps (✓ ✓ (a): 300; ✗ ✗: 350 to 360)."
    assert said in table.notes


def test_a_switch_that_hardly_switches_is_said(tmp_path):
    """With nearly all tokens as neighbours both rows of an ablation are one method."""
    for name, share, said in (("near", 0.95, True), ("apart", 0.6, False)):
        for number, row in enumerate(("full", "no_unprojection")):
            path = write_run(tmp_path / name / str(number), row, 20.0)
            content = json.loads(path.read_text())
            for measured in content["rows"]:
                measured["shared_neighbors"] = share - 0.1 * number
            path.write_text(json.dumps(content))
        (table,) = tables_of(tmp_path / name, views=(4,))
        assert any("95% of a token's neighbours are the same" in note for note in table.notes) == said


def test_a_row_is_what_the_model_does(tmp_path):
    """A label that says something else than the model must not choose the row."""
    changed = {"neighborhood": "image_plane", "similarity": "log"}
    labels = {"name": "full", "unprojection": True, "semantic": True}
    write_run(tmp_path / "0", "full", 20.0, recalibration=changed, ablation=labels)
    (table,) = tables_of(tmp_path, views=(4,))
    rows, _ = body(to_markdown(table))
    assert rows["✗", "✓"][0] == "24.00"
    assert rows["✓", "✓"][0] == "-"


def test_a_checkpoint_that_was_changed_is_another_row(tmp_path):
    """What the command line of `ghgs evaluate` changed in the model tells the row."""
    path = write_run(tmp_path / "0", "full", 20.0, verb="evaluate")
    content = json.loads(path.read_text())
    content["provenance"]["model_config"] = {"recalibration": {"neighborhood": "xyz", "similarity": "none"}}
    path.write_text(json.dumps(content))
    (table,) = tables_of(tmp_path, views=(4,))
    assert body(to_markdown(table))[0]["✓", "✗"][0] == "24.00"


def edited(value, *keys):
    """The change of one value; KeyError removes it."""

    def edit(content):
        for key in keys[:-1]:
            content = content[key]
        if value is KeyError:
            del content[keys[-1]]
        else:
            content[keys[-1]] = value

    return edit


PROVENANCE, ROW = "provenance", ("rows", 0)


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (edited(KeyError, PROVENANCE), "provenance: expected a value; found none"),
        (edited([1], PROVENANCE), r"provenance: expected to be a valid dictionary; found \[1\]"),
        (
            edited("x", PROVENANCE, "config"),
            "provenance.config: expected to be a valid dictionary; found 'x'",
        ),
        (edited(KeyError, PROVENANCE, "config", "recalibration"), "recalibration: expected a mapping"),
        (
            edited("one", PROVENANCE, "config", "seed"),
            "provenance.seed: expected a whole number; found 'one'",
        ),
        (edited(KeyError, PROVENANCE, "data"), "provenance.data: expected a value; found none"),
        (
            edited(3, PROVENANCE, "data", "split"),
            "provenance.data.split: expected to be a valid string; found 3",
        ),
        (edited(None, PROVENANCE, "protocol"), "provenance.protocol: expected to be a valid dictionary"),
        (edited("dirty", PROVENANCE, "git"), "provenance.git: expected to be a valid dictionary"),
        (
            edited(3, PROVENANCE, "training"),
            "provenance.training: expected to be a valid dictionary .*found 3",
        ),
        (edited(KeyError, "rows"), "rows: expected a value; found none"),
        (edited({}, "rows"), "rows: expected to be a valid list; found {}"),
        (edited("x", *ROW), r"rows\[0\]: expected to be a valid dictionary"),
        (edited("high", *ROW, "psnr"), r"rows\[0\]\.psnr: expected to be a valid number.*; found 'high'"),
        (edited("four", *ROW, "views"), r"rows\[0\]\.views: expected to be a valid integer.*; found 'four'"),
        (edited(KeyError, *ROW, "subject"), r"rows\[0\]\.subject: expected a value; found none"),
        (edited(3, "summary"), "summary: expected to be a valid list; found 3"),
    ],
)
def test_edited_results_are_one_line(tmp_path, edit, said):
    """A results file that was changed by hand is named with the key that is wrong."""
    path = write_run(tmp_path / "0", "full", 20.0, training={"steps": 1}, git={"commit": "a" * 40})
    content = json.loads(path.read_text())
    edit(content)
    source = content.get("provenance")
    if isinstance(source, dict) and isinstance(source.get("config"), dict):
        source["config_hash"] = config_hash(source["config"])  # refused by itself otherwise
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=said) as error:
        read_sweep([tmp_path])
    assert "metrics.json" in str(error.value)
    assert "\n" not in str(error.value)
