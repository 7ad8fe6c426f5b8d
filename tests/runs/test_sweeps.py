"""Sweeps run each configuration once: when they grow, are interrupted, or are shared by processes."""

import contextlib
import json
import os
import re
from pathlib import Path

import pytest
from hydra.core.utils import JobReturn, JobStatus

from ghgs_lit.cli import train as train_verb
from ghgs_lit.config import compose, run_of
from ghgs_lit.errors import InputError
from ghgs_lit.runs import job
from ghgs_lit.runs.results import config_hash, read_results
from ghgs_lit.runs.sweep import combinations, run_all
from ghgs_lit.training.loggers import TensorBoardOptions
from tests.cli.test_main import call
from tests.helpers.jobs import (
    executed,
    plan_seeds,
    record_execution,
    work_through,
)
from tests.helpers.processes import PREPARED
from tests.helpers.verbs import succeed

pytestmark = pytest.mark.usefixtures("plans_alone")


def test_a_grid_that_grows_runs_what_is_missing(sweep):
    """A larger grid does not repeat finished runs; keys without influence create no new runs."""
    code, out, _ = sweep("seed=1,2")
    assert (code, len(executed(sweep.directory))) == (0, 2)
    out = sweep.succeed("seed=1,2,3")
    assert "3 runs: 2 done before, 1 to do" in out
    names = executed(sweep.directory)
    assert len(names) == len(set(names)) == 3
    sweep("seed=2,3", "logger=none", "data.workers=1")
    assert executed(sweep.directory) == names  # keys without influence create no new run
    for name in names:
        source = read_results(sweep.directory / name / "metrics.json")["provenance"]
        assert name == source["config_hash"] == config_hash(source["config"])


def test_directories_of_a_users_own_hold_one_configuration_each(sweep):
    """Regression: a grid in numbered directories was "done before" and never trained, because numbering
    restarts."""
    numbered = "hydra.sweep.subdir=${hydra.job.num}"
    code, out, _ = sweep(numbered, "seed=1,2")
    assert (code, executed(sweep.directory)) == (0, ["0", "1"])
    code, out, err = sweep(numbered, "seed=2")
    assert (code, len(err.splitlines())) == (1, 1)
    assert f"{sweep.directory / '0'}: expected a directory without a run" in err
    assert "found metrics.json of another configuration: seed: 1 -> 2 (" in err
    code, out, _ = sweep(numbered, "seed=1,2")
    assert "2 runs: 2 done before" in out
    assert executed(sweep.directory) == ["0", "1"]


def test_a_folder_that_cannot_be_written_to_is_refused_by_the_plan(sweep, monkeypatch):
    """Regression: the dry run passed. Root may write anywhere, so ``os.access`` is replaced."""
    access = os.access
    monkeypatch.setattr(
        os, "access", lambda path, mode: path != sweep.directory.parent and access(path, mode)
    )
    for dry in ("true", "false"):
        code, _, err = sweep("seed=1,2", f"dry_run={dry}")
        expected = f"expected a folder that can be written to for the runs; found '{sweep.directory.parent}'"
        assert (code, err) == (1, f"ghgs train: hydra.sweep.dir: {expected}\n")
    sweep.directory.write_text("no folder")
    code, _, err = sweep("seed=1,2", "dry_run=true")
    assert (code, f"for the runs; found '{sweep.directory}'" in err) == (1, True)


def test_two_runs_in_one_directory_are_refused_before_any_is_trained(sweep):
    for dry in ("dry_run=true", "dry_run=false"):
        err = sweep.refuse("hydra.sweep.subdir=same", "seed=1,2", dry)
        assert "hydra.sweep.subdir: expected a directory for each configuration; found" in err
    assert not sweep.directory.exists()


def test_directories_may_say_what_sets_them_apart(sweep):
    """Hydra's ``override_dirname`` idiom, whose values need quotes."""
    grid = ("hydra.sweep.subdir=${hydra.job.override_dirname}", "seed=1,2", "evaluation.views=[4]")
    for _ in range(2):
        code, _, err = sweep(*grid)
        assert code == 0, err
    assert executed(sweep.directory) == [f"evaluation.views=[4],seed={seed}" for seed in (1, 2)]


def test_dry_run_runs_nothing_and_prints_states(sweep):
    out = sweep.succeed("seed=1,2", "dry_run=true", "trainer.max_steps=100")
    assert not sweep.directory.exists()
    assert "2 runs: 2 missing\nnothing was run" in out
    sweep("seed=1", "trainer.max_steps=100")
    names = executed(sweep.directory)
    out = sweep.succeed("seed=1,2,3", "dry_run=true", "trainer.max_steps=100")
    assert executed(sweep.directory) == names
    assert re.search(rf"{names[0]} +done +100 +20\.\d\d +seed=1\n", out)
    assert "3 runs: 1 done, 2 missing" in out


def test_curves_are_named_after_what_distinguishes_a_run(sweep, monkeypatch, tmp_path):
    """TensorBoard shows these names; a run keeps its folder when another command continues it."""

    def log(run, directory, stats):
        folder = Path(TensorBoardOptions().build(str(directory)).log_dir)
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "events.out.tfevents.1").touch()
        (directory / "checkpoints").mkdir(exist_ok=True)
        (directory / "checkpoints" / "last.ckpt").touch()
        return record_execution(run, directory, stats)

    monkeypatch.setattr(train_verb, "train", log)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").mkdir()
    for name in ("a/b", "c"):
        (tmp_path / name).write_text("weights")
    grid = ("ablation=full,neither", "evaluation.views=[3],[4]", "init_from=a/b,c")
    shared = ("allow_random_encoder=true", "data.people.train=4")
    assert sweep(*grid, *shared)[0] == 0
    expected = {"ablation=full,init_from=a_b", "ablation=full,init_from=c"}
    expected |= {name.replace("full", "neither") for name in expected}
    found = sorted(sweep.directory.glob("*/tensorboard/*/events.*"))
    assert (len(found), {path.parent.name for path in found}) == (8, expected)
    for path in sweep.directory.glob("*/metrics.json"):
        path.unlink()
    assert sweep("ablation=full", "evaluation.views=[3],[4]", "init_from=a/b,c", *shared)[0] == 0
    assert sorted(sweep.directory.glob("*/tensorboard/*/events.*")) == found


def test_a_failing_run_is_named_and_the_others_are_run(sweep, monkeypatch):
    """One failing run must not stop an overnight sweep."""

    def bad(run, directory, stats):
        if run.seed == 1:
            raise InputError("step 3: expected finite losses; found nan")
        return record_execution(run, directory, stats)

    monkeypatch.setattr(train_verb, "train", bad)
    code, out, err = sweep("seed=1,2")
    assert code == 1
    assert "expected finite losses" in err
    assert "2 runs: 1 done, 1 missing" in out
    assert len(executed(sweep.directory)) == 1


def test_an_impossible_job_fails_before_any_is_launched(sweep):
    """An invalid value is found before hours of training."""
    err = sweep.refuse("seed=1,-2")
    assert "seed: expected an integer >= 0" in err
    err = sweep.refuse("seed=1,2", "trainer.devices=2", "dry_run=true")
    assert "trainer.devices: expected 1 in a sweep, or hydra/launcher=slurm" in err
    assert not executed(sweep.directory)


@pytest.mark.parametrize(
    ("trainer", "fits"),
    [
        ({"devices": 1}, True),
        ({"devices": [1]}, True),
        ({"devices": [0, 1]}, False),
        ({"devices": 2}, False),
        ({"devices": "auto", "accelerator": "cpu"}, True),
        ({"devices": -1, "accelerator": "cpu"}, True),
        ({"devices": "auto", "accelerator": "gpu"}, False),
        ({"devices": "auto", "accelerator": "auto"}, False),
        ({"devices": 1, "num_nodes": 2}, False),
    ],
)
def test_one_process_may_be_said_in_several_ways(monkeypatch, trainer, fits):
    """``[1]`` is only the second GPU; ``auto`` is one process on a CPU. The test simulates two GPUs."""
    monkeypatch.setattr("torch.cuda.device_count", lambda: 2)
    base = run_of("train", ["trainer=gpu"])
    run = base.replace(trainer={**base.plain["trainer"], **trainer})
    job.check_launcher(run, "submitit_slurm")
    with (
        contextlib.nullcontext() if fits else pytest.raises(InputError, match=r"trainer\.devices: expected 1")
    ):
        job.check_launcher(run, "basic")


def test_two_processes_share_a_sweep_and_both_see_all_of_it(tmp_path):
    """Two processes on one sweep train no run twice, and both end with all results."""
    count, barrier = 8, PREPARED.Barrier(2)
    processes = [PREPARED.Process(target=work_through, args=(tmp_path, count, barrier)) for _ in range(2)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert sorted(executed(tmp_path)) == sorted(
        item.directory.path.name for item in plan_seeds(tmp_path, count)
    )
    assert [p.read_text() for p in tmp_path.glob("seen_*")] == ["8", "8"]
    pids = {line.split()[1] for line in (tmp_path / "executed").read_text().splitlines()}
    assert len(pids) == 2


def test_a_sweep_returns_to_runs_that_others_worked_on(tmp_path):
    """A run locked by another process is launched again, because that process may have died."""
    items, launched = plan_seeds(tmp_path, 2), []

    def launch(jobs, first):
        launched.append([overrides[0] for overrides in jobs])
        values = [job.BUSY if len(launched) == 1 and name == "0" else 20.0 for (name,) in jobs]
        return [JobReturn(_return_value=value, status=JobStatus.COMPLETED) for value in values]

    assert [result.return_value for result in run_all(items, launch)] == [20.0, 20.0]
    assert launched == [["0", "1"], ["0"]]


def test_the_command_line_replaces_a_sweeps_own_values():
    """``seed=7`` replaces the three seeds of a named sweep instead of adding to them."""
    own = {"seed": "1,2,3", "views": "v4"}
    assert combinations(own, ["seed=7", "model=hull"]) == [["views=v4", "seed=7", "model=hull"]]
    assert len(combinations(own, ["ablation=full,neither"])) == 6


def test_a_sweep_over_all_options_of_a_group(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    command = ("train", "-m", "experiment=demo", "dry_run=true", "ablation=glob(*)")
    code, out, _ = call(monkeypatch, capsys, *command)
    assert (code, out.count("ablation=")) == (0, 4), out


def compose_train(*overrides: str):
    return compose("train", overrides, with_hydra=True)


@pytest.mark.parametrize(
    ("name", "count", "data"),
    [
        ("table1", 6, "zju_mocap"),
        ("table2", 9, "thuman2"),
        ("table3", 3, "thuman2"),
        ("table4", 20, "thuman2"),
    ],
)
def test_named_sweeps(name, count, data):
    """The paper's tables require exactly these runs."""
    cfg = compose_train(f"sweep={name}")
    assert cfg.hydra.mode.name == "MULTIRUN"
    assert cfg.data.name == data
    assert cfg.model.name == "paper"
    assert len(combinations(cfg.hydra.sweeper.params, [f"sweep={name}"])) == count


def test_a_named_sweep_needs_no_flag(monkeypatch, capsys, tmp_path):
    """Without its own mode, ``sweep=table4`` would train a single run."""
    there = f"hydra.sweep.dir={tmp_path}"
    out = succeed(capsys, "train", "sweep=table4", "seed=1", "dry_run=true", there)
    assert "4 runs: 4 missing" in out


def test_a_file_of_ones_own_may_say_that_it_is_a_sweep(sweep, tmp_path, monkeypatch, capsys):
    """Its directory is ``hydra.sweep.dir``, also without a flag."""
    (tmp_path / "conf" / "experiment").mkdir(parents=True)
    own = "# @package _global_\nhydra: {mode: MULTIRUN, sweeper: {params: {seed: '1,2'}}}\n"
    (tmp_path / "conf" / "experiment" / "mine.yaml").write_text(own)
    words = ["--config-dir", str(tmp_path / "conf"), "experiment=mine", f"hydra.sweep.dir={sweep.directory}"]
    code, _, err = call(monkeypatch, capsys, "train", *words)
    assert (code, len(executed(sweep.directory))) == (0, 2), err


def test_tables_share_runs_and_take_other_data(sweep):
    """A run shared by two tables has one hash; other data on the command line changes the hash."""

    def names(*overrides):
        out = sweep.succeed("dry_run=true", "seed=1", *overrides)
        return {word for word in out.split() if len(word) == 12 and set(word) <= set("0123456789abcdef")}

    table2, table4 = names("sweep=table2"), names("sweep=table4")
    assert (len(table2), len(table4), len(table2 & table4)) == (3, 4, 1)
    small = names("sweep=table4", "data=synthetic", "encoder=vggt_nano", "trainer=cpu")
    assert len(small) == 4
    assert not small & table4


def test_hash_ignores_only_what_no_number_depends_on():
    """Two different runs must never share a directory."""
    base = {"seed": 1, "resume": None, "data": {"root": "a", "workers": 0}, "logger": {"csv": {}}}
    same = {"seed": 1, "resume": "x", "data": {"root": "a", "workers": 4}, "logger": {}}
    assert config_hash(base) == config_hash(same)
    assert config_hash(base) != config_hash({**base, "data": {"root": "b", "workers": 0}})
    assert config_hash(base) == config_hash(dict(reversed(base.items())))
    assert json.loads(json.dumps(base)) == base
