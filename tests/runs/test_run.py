"""A single run: its directory with results, sessions and lock, and checks before it starts."""

import contextlib
import json
import os
import signal
import time

import pytest

from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.runs.job import check_config
from ghgs_lit.runs.results import read_results
from ghgs_lit.runs.run import RunDirectory
from tests.helpers.jobs import (
    executed,
    hold_run,
    write_finished_run,
)
from tests.helpers.processes import PREPARED


def test_results_that_are_not_whole_are_no_results(tmp_path):
    """A truncated ``metrics.json`` must not mark a run as done."""
    run = RunDirectory(tmp_path / "run")
    assert run.state == "missing"
    run.path.mkdir()
    (run.path / "metrics.json").write_text('{"format_version": 1, "summ')
    assert run.state == "missing"
    write_finished_run(run.path, {"seed": 1})
    assert run.state == "done"
    assert run.metric == 20.0


FIGURES = [(f"{part}.0.psnr", value, rf"\.{part}\[0\]\.psnr") for part in ("rows", "summary")
           for value in (float("nan"), float("inf"), "20", [20])]  # fmt: skip


@pytest.mark.parametrize(
    ("place", "value", "key"), [*FIGURES, ("provenance.config.seed", 2, r": provenance\.config")]
)
def test_results_that_were_changed_are_refused(tmp_path, place, value, key):
    """A changed seed would move the run to another table row; metrics must be finite numbers."""
    write_finished_run(tmp_path, {"seed": 1})
    path = tmp_path / "metrics.json"
    content = part = json.loads(path.read_text())
    *before, last = (int(key) if key.isdecimal() else key for key in place.split("."))
    for key_before in before:
        part = part[key_before]
    part[last] = value
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=rf"metrics\.json{key}: expected"):
        read_results(path)
    assert not RunDirectory(tmp_path).done


def test_a_lock_ends_with_its_process_and_not_before(tmp_path):
    """Neither a killed process nor a forked child that outlives it may block a run."""
    ready = PREPARED.Event()
    holder = PREPARED.Process(target=hold_run, args=(tmp_path, ready))
    holder.start()
    assert ready.wait(30)
    run = RunDirectory(tmp_path)
    assert run.state == "running"
    assert str(holder.pid) in run.owner
    with run.claim() as mine:
        assert not mine
    os.kill(holder.pid, signal.SIGKILL)
    holder.join()
    with run.claim() as mine:
        assert mine
        assert run.state == "running"
        with RunDirectory(tmp_path).claim() as again:
            assert not again
        child = os.fork()
        if child == 0:  # like a data worker that outlives its killed parent process
            time.sleep(30)
            os._exit(0)
    try:
        assert run.state == "missing"
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def test_a_frozen_encoder_without_weights_is_refused(verb, tmp_path):
    """Otherwise the paper's sweeps would train for days on features of a random encoder."""
    for name in ("sweep=table4", "experiment=zju_mocap", "experiment=thuman2"):
        where = (f"hydra.sweep.dir={tmp_path / 'sweep'}", f"hydra.run.dir={tmp_path / 'run'}")
        err = verb.refuse(name, f"data.root={tmp_path}", *where)
        assert "init_from: expected a checkpoint with the encoder's weights" in err
        assert "ghgs import" in err
    assert not executed(tmp_path / "sweep")
    code, out, _ = verb("sweep=table4", f"hydra.sweep.dir={tmp_path / 'sweep'}", "dry_run=true")
    assert code == 1
    assert out.count("would be refused: init_from: expected") == 1


BRANCH = "encoder.semantic={width: 16, depth: 1, heads: 2, channels: 8}"


@pytest.mark.parametrize(
    ("overrides", "refused"),
    [
        (["encoder.trainable=all"], None),
        (["encoder.trainable=none", "init_from=vggt.ckpt"], None),
        (["encoder.trainable=last_1", "resume=last.ckpt"], None),
        (["encoder.trainable=none", "allow_random_encoder=true"], None),
        (["encoder.trainable=last_1"], r"init_from: .*encoder\.trainable=last_1"),
        ([BRANCH], "init_from: expected a checkpoint of `ghgs pretext`"),
        ([BRANCH, "init_from=pretext.ckpt"], None),
        ([BRANCH, "allow_random_encoder=true"], None),
    ],
)
def test_parts_of_an_encoder_that_do_not_learn_need_weights(overrides, refused):
    """They would stay random; deliberate experiments are accepted."""
    accepted = contextlib.nullcontext()
    with accepted if refused is None else pytest.raises(InputError, match=refused):
        check_config(run_of("train", overrides))


def test_a_sweep_overwrites_nothing(verb, tmp_path):
    """Sweeps resume their runs; ``overwrite`` would train all of them again."""
    err = verb.refuse("-m", f"hydra.sweep.dir={tmp_path}", "seed=1,2", "overwrite=true")
    assert "overwrite: expected false in a sweep" in err
