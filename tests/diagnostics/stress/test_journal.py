"""Finished pieces of work are kept, whatever happens to the process that writes them."""

from ghgs_lit.diagnostics.stress import run
from ghgs_lit.diagnostics.stress.run import Journal


def test_what_is_done_is_there_after_a_kill(tmp_path):
    """A line that was cut off is lost, and neither the lines before it nor the next one."""
    path = tmp_path / "run" / "pieces.jsonl"
    first = Journal(path)
    first.add("a", [{"x": 1}])
    assert "a" in first
    with path.open("a") as file:
        file.write('{"key": "b", "co')
    again = Journal(path)
    assert again["a"] == [{"x": 1}]
    assert "b" not in again
    again.add("c", [])
    assert "c" in Journal(path)


def test_rows_of_other_code_are_not_taken_over(tmp_path, monkeypatch, capsys):
    """A table must not mix numbers of two versions."""
    path = tmp_path / "pieces.jsonl"
    done, left = (run.Task("cosine", family, 1) for family in ("ordinary", "zero_features"))
    Journal(path).add(done.key, [])
    rows = run.run_tasks([done, left], path, workers=0)
    assert capsys.readouterr().out == f"{path}: 1 of 2 families are done already\n"
    assert {row["family"] for row in rows} == {"zero_features"}
    monkeypatch.setattr(run, "code_digest", lambda: "other")
    assert done.key not in Journal(path)
