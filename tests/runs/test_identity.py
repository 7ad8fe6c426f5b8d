"""A directory belongs to one configuration: what resumes in it, what is rejected, and what may be
deleted."""

import json
import os
import shutil
import time
from pathlib import Path

import pytest

from ghgs_lit.config import run_of
from ghgs_lit.config.compose import saved_text
from ghgs_lit.errors import InputError
from ghgs_lit.runs import job
from ghgs_lit.runs.results import config_hash
from ghgs_lit.runs.run import MARKER, RunDirectory
from tests.helpers.jobs import hold_run, record_execution, write_finished_run
from tests.helpers.processes import PREPARED

RUN = run_of("train", ["optimizer.lr=0.5", "trainer.max_steps=4"])


EVENTS = "tensorboard/events.out.tfevents.1"


class Killed(BaseException):
    pass


def train_to(checkpoint: bool, seen: list):
    """Training function that is killed before or after its first checkpoint."""

    def train(run, directory, stats):
        seen.append(run.resume)
        for name in ("csv/metrics.csv", EVENTS, *["checkpoints/last.ckpt"] * checkpoint):
            (directory / name).parent.mkdir(exist_ok=True)
            (directory / name).write_text("seed 1")
        raise Killed

    return train


def train_until_killed(path, run=RUN, checkpoint=True) -> list:
    """Train in a directory until the process is killed; returns the checkpoints it resumed from."""
    seen = []
    with pytest.raises(Killed):
        job.train_once(RunDirectory(path), run, train_to(checkpoint, seen))
    return seen


def train_to_end(path, run=RUN) -> float:
    return job.train_once(RunDirectory(path), run, record_execution)


def test_a_single_run_goes_on_with_the_same_command(tmp_path, capsys):
    """A batch system that requeues a job repeats its command: nothing is rejected and nothing is lost."""
    path = tmp_path / "run"
    last = str(path / "checkpoints" / "last.ckpt")
    assert train_until_killed(path, checkpoint=False) == [None]
    assert train_until_killed(path) == [None]
    name = RunDirectory(path).marker.id
    assert train_until_killed(path) == [last]
    assert train_to_end(path) == 20.5
    assert [s["resumed"] for s in RunDirectory(path).sessions()] == [
        None,
        None,
        *["checkpoints/last.ckpt"] * 2,
    ]
    assert "done before" not in capsys.readouterr().out
    assert train_to_end(path) == 20.5  # not trained again
    assert f"done before: {path}" in capsys.readouterr().out
    assert len(RunDirectory(path).sessions()) == 4
    assert RunDirectory(path).marker.id == name


def test_what_is_trained_again_leaves_no_logs_of_before(tmp_path):
    """Regression: a kill before the first checkpoint left event files, so that the same steps were logged
    twice."""
    train_until_killed(tmp_path / "run", checkpoint=False)
    (tmp_path / "run" / EVENTS).rename(tmp_path / "run" / f"{EVENTS}.x")
    train_until_killed(tmp_path / "run", checkpoint=False)
    assert os.listdir(tmp_path / "run" / "tensorboard") == [Path(EVENTS).name]


def test_a_moved_run_goes_on(tmp_path):
    """No file of a run contains the path of its directory."""
    train_until_killed(tmp_path / "run")
    shutil.move(tmp_path / "run", tmp_path / "moved")
    assert train_until_killed(tmp_path / "moved") == [str(tmp_path / "moved" / "checkpoints" / "last.ckpt")]
    named = [
        p for p in (tmp_path / "moved").rglob("*") if p.is_file() and str(tmp_path).encode() in p.read_bytes()
    ]
    assert named == []


@pytest.mark.parametrize("is_done", [False, True])
def test_two_configurations_do_not_share_a_directory(tmp_path, is_done):
    """Regression: the second one was reported as "done before" and never trained."""
    train_to_end(tmp_path / "run") if is_done else train_until_killed(tmp_path / "run")
    before = sorted((p, p.stat().st_mtime_ns) for p in (tmp_path / "run").rglob("*") if p.name != ".lock")
    with pytest.raises(
        InputError, match=r"run: expected a directory without a run or .*; found .* \(.*overwrite=true"
    ):
        train_until_killed(tmp_path / "run", RUN.replace(seed=2))
    after = sorted((p, p.stat().st_mtime_ns) for p in (tmp_path / "run").rglob("*") if p.name != ".lock")
    assert after == before
    other = RunDirectory(tmp_path / "run").of(RUN.replace(seed=2))
    assert (other.done, other.metric) == (False, None)


def test_the_refusal_names_what_differs(verb, tmp_path):
    """The error lists differing keys, so that the user need not compare two configurations."""
    where = f"hydra.run.dir={tmp_path / 'run'}"
    assert verb(where)[0] == 0
    (tmp_path / "run" / "config.yaml").write_text(saved_text(run_of("train", ["resume=null"]).plain))
    err = verb.refuse(where, "seed=2")
    assert "found metrics.json of another configuration: seed: 1 -> 2 (" in err
    assert "found metrics.json (" in verb(where, "resume=null")[2]


def test_a_checkpoint_of_the_run_itself_goes_on_with_other_settings(tmp_path):
    """``resume=`` continues the training of a finished run."""
    train_to_end(tmp_path / "run")
    train_until_killed(
        tmp_path / "run", RUN.replace(resume=str(tmp_path / "run" / "checkpoints" / "last.ckpt"))
    )
    best = str(tmp_path / "run" / "checkpoints" / "best.ckpt")
    changed = RUN.replace(optimizer={**RUN.plain["optimizer"], "lr": 0.1})
    assert train_until_killed(tmp_path / "run", changed.replace(resume=best)) == [best]
    assert RunDirectory(tmp_path / "run").marker.config_hash == config_hash(changed.plain)


def test_a_run_that_began_elsewhere_goes_on_here(tmp_path):
    """Repeating a command that starts from another run's checkpoint resumes instead of starting from it
    again."""
    other = tmp_path / "other.ckpt"
    other.touch()
    from_other = RUN.replace(resume=str(other))
    assert train_until_killed(tmp_path / "run", from_other) == [str(other)]
    assert train_until_killed(tmp_path / "run", from_other) == [
        str(tmp_path / "run" / "checkpoints" / "last.ckpt")
    ]
    train_until_killed(tmp_path / "second")
    with pytest.raises(InputError, match="expected a directory without a run"):
        train_until_killed(tmp_path / "second", from_other)
    with pytest.raises(InputError, match="expected a directory without a run"):
        train_until_killed(tmp_path / "second", RUN.replace(resume=None))


@pytest.mark.parametrize(
    "file", ["checkpoints/other.pth", "csv/table.csv", "metrics.json", "pictures/holiday.jpg"]
)
@pytest.mark.parametrize("overwrite", [False, True])
def test_files_of_others_are_neither_deleted_nor_mixed_with_a_run(verb, tmp_path, file, overwrite):
    """Regression: ``overwrite=true hydra.run.dir=.`` deleted the user's pictures."""
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text("mine")
    err = verb.refuse(f"hydra.run.dir={tmp_path}", f"overwrite={overwrite}")
    assert (
        f"expected a directory without a run or other files of these names; found {file.split('/')[0]}" in err
    )
    assert (tmp_path / file).read_text() == "mine"
    assert not (tmp_path / MARKER).exists()


FOREIGN = ("notes.txt", "tensorboard/notes.txt", "pictures/holiday.png", "checkpoints/mine.ckpt", "csv/a.csv")


def test_overwriting_deletes_a_run_and_nothing_else(tmp_path):
    """The user's files remain, also inside the run's folders; the new run has a new ID."""
    path = tmp_path / "run"
    train_until_killed(path)
    before = RunDirectory(path).marker.id
    for name in FOREIGN:
        (path / name).parent.mkdir(exist_ok=True)
        (path / name).write_text("mine")
    train_until_killed(path, RUN.replace(seed=2, overwrite=True), checkpoint=False)
    assert all((path / name).read_text() == "mine" for name in FOREIGN)
    assert not (path / "checkpoints" / "last.ckpt").exists()
    assert RunDirectory(path).marker.id != before
    assert len(RunDirectory(path).sessions()) == 1


@pytest.mark.parametrize("place", ["pictures", "checkpoints", "faults", "tensorboard/seed=2"])
def test_nothing_is_written_through_links(verb, tmp_path, place):
    """Regression: pictures were written to the target of a link."""
    run, outside = tmp_path / "sweep" / "run", tmp_path / "outside"
    outside.mkdir()
    (run / place).parent.mkdir(parents=True, exist_ok=True)
    (run / place).symlink_to(outside)
    err = verb.refuse(f"hydra.run.dir={run}", "seed=2")
    assert "expected a file or folder of the run; found 'a link'" in err
    assert not list(outside.iterdir())


def test_overwriting_is_for_the_command_line(verb, tmp_path):
    """Regression: an external file with ``hydra.run.dir`` and ``overwrite`` replaced a run."""
    train_until_killed(tmp_path / "run")
    (tmp_path / "conf" / "experiment").mkdir(parents=True)
    own = f"# @package _global_\nhydra: {{run: {{dir: '{tmp_path / 'run'}'}}}}\noverwrite: true\n"
    (tmp_path / "conf" / "experiment" / "x.yaml").write_text(own)
    code, _, err = verb("--config-dir", str(tmp_path / "conf"), "experiment=x")
    expected = "overwrite: expected a value on the command line alone; found 'true in a file'"
    assert (code, err) == (1, f"ghgs train: {expected}\n")
    assert RunDirectory(tmp_path / "run").checkpoint is not None


@pytest.mark.parametrize("key", ["init_from", "resume"])
def test_overwriting_never_deletes_what_the_run_starts_from(tmp_path, key):
    train_until_killed(tmp_path)
    last = tmp_path / "checkpoints" / "last.ckpt"
    run = RUN.replace(overwrite=True, **{key: str(last)})
    if key == "init_from":
        with pytest.raises(InputError, match="init_from: expected a file outside the run"):
            train_until_killed(tmp_path, run)
    else:
        assert train_until_killed(tmp_path, run) == [str(last)]
    assert last.exists()


def test_a_job_that_is_queued_again_does_not_overwrite_itself(tmp_path, monkeypatch):
    """The command of a requeued job still contains ``overwrite=true``."""
    run = RUN.replace(overwrite=True)
    monkeypatch.setenv("SLURM_JOB_ID", "77")
    assert train_until_killed(tmp_path, run) == [None]
    assert train_until_killed(tmp_path, run) == [None]
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert train_until_killed(tmp_path, run) == [str(tmp_path / "checkpoints" / "last.ckpt")]
    monkeypatch.setenv("SLURM_JOB_ID", "78")
    assert train_until_killed(tmp_path, run) == [None]


@pytest.mark.parametrize("text", ["[]", "{", '{"id": "a"}'])
def test_a_marker_of_another_program_is_refused(tmp_path, text):
    (tmp_path / MARKER).write_text(text)
    (tmp_path / "pictures").mkdir()
    with pytest.raises(InputError, match=r"run\.json"):
        train_until_killed(tmp_path, RUN.replace(overwrite=True))
    assert (tmp_path / "pictures").exists()


def test_the_loser_of_two_starts_leaves_the_winner_alone(verb, tmp_path):
    """Regression: the losing process deleted the directory in which the winner had begun."""
    run, ready = tmp_path / "run", PREPARED.Event()
    holder = PREPARED.Process(target=hold_run, args=(run, ready))
    holder.start()
    try:
        assert ready.wait(30)
        (run / "config.yaml").write_text("of the winner")
        for name in (".lock", "config.yaml"):  # the winner started later
            os.utime(run / name, (time.time() + 60,) * 2)
        err = verb.refuse(f"hydra.run.dir={run}")
        assert f"found process {holder.pid} on" in err
        assert (run / "config.yaml").read_text() == "of the winner"
        assert RunDirectory(run).state == "running"
    finally:
        holder.kill()
        holder.join()


@pytest.mark.parametrize("name", ["LOCAL_RANK", "RANK", "SLURM_PROCID"])
def test_numbers_of_processes_that_were_left_over_do_not_count(verb, tmp_path, monkeypatch, name):
    """Regression: a run was "done" without configuration, sessions or lock."""
    from lightning.pytorch.utilities import rank_zero_only

    monkeypatch.setenv(name, "1")
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    assert verb(f"hydra.run.dir={tmp_path / 'run'}")[0] == 0
    run = RunDirectory(tmp_path / "run")
    assert (run.done, len(run.sessions()), run.marker is None) == (True, 1, False)
    assert rank_zero_only.rank == 0


def test_results_are_those_of_the_configuration(tmp_path):
    write_finished_run(tmp_path, RUN.plain)
    assert RunDirectory(tmp_path).of(RUN).metric == 20
    assert RunDirectory(tmp_path).of(RUN.replace(resume=None)).done
    assert not RunDirectory(tmp_path).of(RUN.replace(seed=2)).done
    # A verb may complete the configuration of its command, whose hash identifies the run.
    content = json.loads((tmp_path / "metrics.json").read_text())
    content["provenance"]["run"] = {"config_hash": config_hash(RUN.replace(seed=2).plain)}
    (tmp_path / "metrics.json").write_text(json.dumps(content))
    assert RunDirectory(tmp_path).of(RUN.replace(seed=2)).done


def test_a_refused_command_changes_no_file_of_the_run(verb, tmp_path):
    """Regression: ``.hydra`` contained another seed than the run."""
    where = f"hydra.run.dir={tmp_path / 'run'}"
    assert verb(where)[0] == 0
    before = {p: p.read_bytes() for p in (tmp_path / "run").rglob("*") if p.is_file()}
    assert verb(where, "seed=2")[0] == 1
    assert {p: p.read_bytes() for p in (tmp_path / "run").rglob("*") if p.is_file()} == before
