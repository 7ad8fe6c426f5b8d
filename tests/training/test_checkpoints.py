"""Checkpoints as files: written whole or not at all, when they are due, and which is the best."""

import os
import signal
from datetime import timedelta

import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.training.checkpoints import AtomicCheckpointIO, CheckpointOptions


def test_kill_while_writing_leaves_the_checkpoint_before(tmp_path, monkeypatch):
    """A kill in the middle of writing costs neither the previous checkpoint nor disk space."""
    path, files = tmp_path / "last.ckpt", AtomicCheckpointIO()
    files.save_checkpoint({"step": 1, "weights": torch.arange(1000.0)}, path)
    child = os.fork()
    if child == 0:

        def half(content, path):
            path.write_bytes(b"half a checkpoint")
            os.kill(os.getpid(), signal.SIGKILL)

        monkeypatch.setattr(torch, "save", half)
        files.save_checkpoint({"step": 2}, path)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status)
    assert os.WTERMSIG(status) == signal.SIGKILL
    assert files.load_checkpoint(path)["step"] == 1
    monkeypatch.undo()
    files.save_checkpoint({"step": 3}, path)
    assert files.load_checkpoint(path)["step"] == 3
    assert [p.name for p in tmp_path.iterdir()] == ["last.ckpt"]


def test_the_rename_comes_after_the_disk_has_all(tmp_path, monkeypatch):
    """After a power cut the file has its content: it is synced before it gets its name."""
    calls = []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(os, name, lambda *a, _n=name, _r=real: (calls.append(_n), _r(*a)))
    AtomicCheckpointIO().save_checkpoint({"step": 1}, tmp_path / "a.ckpt")
    assert calls == ["fsync", "replace", "fsync"]


@pytest.mark.parametrize("minutes", [0, -1.0])
def test_minutes_are_positive(minutes):
    """An impossible interval is refused with its key."""
    with pytest.raises(InputError, match="minutes"):
        CheckpointOptions(filename="last", minutes=minutes)


def test_minutes_are_minutes():
    """Lightning has the interval as a timedelta, beside the steps."""
    saver = CheckpointOptions(filename="last", minutes=2.5, every_n_train_steps=7).build()
    assert saver._train_time_interval == timedelta(seconds=150)
    assert saver._every_n_train_steps == 7


def test_a_best_checkpoint_that_is_gone_is_found_again(tmp_path):
    """Its score would keep every later one from being written."""
    path = tmp_path / "best.ckpt"
    before, after = (CheckpointOptions(filename="best", monitor="val/psnr").build() for _ in range(2))
    before.dirpath = after.dirpath = str(tmp_path)
    before.best_model_path, before.best_model_score = str(path), torch.tensor(30.0)
    before.best_k_models = {str(path): torch.tensor(30.0)}
    after.load_state_dict(before.state_dict())
    assert (after.best_model_path, after.best_model_score, after.best_k_models) == ("", None, {})
    path.touch()
    after.load_state_dict(before.state_dict())
    assert (after.best_model_path, after.best_model_score) == (str(path), 30)


def test_a_moved_run_knows_its_best_checkpoint(tmp_path, recwarn):
    """The first, worse validation after a move replaced it. States name files, never folders."""
    old, new = tmp_path / "old" / "checkpoints", tmp_path / "new" / "checkpoints"
    before, after = (CheckpointOptions(filename="best", monitor="val/psnr").build() for _ in range(2))
    before.dirpath, after.dirpath = str(old), str(new)
    path, score = str(old / "best.ckpt"), torch.tensor(30.0)
    before.best_model_path = before.kth_best_model_path = path
    before.best_model_score = before.kth_value = score
    before.best_k_models = {path: score}
    state = before.state_dict()
    assert str(tmp_path) not in str(state)
    new.mkdir(parents=True)
    (new / "best.ckpt").touch()
    after.load_state_dict(state)
    assert after.best_model_path == after.kth_best_model_path == str(new / "best.ckpt")
    assert (after.best_k_models, after.best_model_score) == ({str(new / "best.ckpt"): score}, score)
    assert not recwarn.list


def test_a_state_names_no_file_of_other_folders(tmp_path):
    """Lightning deletes what a state calls the worst checkpoint."""
    subject = CheckpointOptions(filename="best", monitor="val/psnr").build()
    subject.dirpath = str(tmp_path / "run" / "checkpoints")
    (tmp_path / "run" / "checkpoints").mkdir(parents=True)
    (tmp_path / "run" / "checkpoints" / "a.ckpt").touch()
    state = subject.state_dict() | {"best_k_models": {"../../a.ckpt": torch.tensor(1.0)}}
    subject.load_state_dict(state | {"kth_best_model_path": "/etc/a.ckpt", "best_model_path": "../a.ckpt"})
    own = str(tmp_path / "run" / "checkpoints" / "a.ckpt")
    assert {subject.kth_best_model_path, subject.best_model_path, *subject.best_k_models} == {own}
