"""Files shared by processes: complete or absent, and locks that end with their process."""

import multiprocessing
import os
import resource
import signal
import socket
import subprocess
import sys

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from ghgs_lit.errors import InputError
from ghgs_lit.files import (
    is_locked,
    lock,
    lock_owner,
    name_folder_in_errors,
    require_free,
    require_no_links,
    write_atomically,
    write_text_atomically,
)
from tests.helpers.processes import PREPARED


def names(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_failing_writer_leaves_the_old_file_or_none(tmp_path):
    """A run that dies while writing must neither lose the last checkpoint nor leave half of a new one."""

    def fail(temporary):
        temporary.write_text("half")
        raise OSError("disk full")

    path = tmp_path / "new" / "a.json"
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, fail)
    assert names(path.parent) == []
    write_text_atomically(path, "old")
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, fail)
    assert path.read_text() == "old"
    assert names(path.parent) == ["a.json"]


def test_leftovers_of_dead_processes_are_removed_and_no_others(tmp_path):
    """Killed runs must not fill the disk; a process that is still writing must not lose its file."""
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    host = socket.gethostname()
    kept = {f".a.ckpt.{host}.{os.getppid()}.tmp", f".a.ckpt.elsewhere.{dead.pid}.tmp", "b.ckpt"}
    for name in (f".a.ckpt.{host}.{dead.pid}.tmp", *kept):
        (tmp_path / name).write_text("half")
    write_text_atomically(tmp_path / "a.ckpt", "whole")
    assert names(tmp_path) == sorted({*kept, "a.ckpt"})


def write_often(path, letter):
    for _ in range(200):
        write_text_atomically(path, letter * 10_000)


def test_two_processes_write_one_file_and_readers_see_whole_ones(tmp_path):
    """Two processes of a sweep write the same plan: a reader must never get a mixture."""
    path = tmp_path / "plan"
    writers = [PREPARED.Process(target=write_often, args=(path, letter)) for letter in "ab"]
    for writer in writers:
        writer.start()
    seen = set()
    while any(writer.is_alive() for writer in writers):
        if path.exists():
            seen.add(path.read_text())
    assert all(writer.exitcode == 0 for writer in writers)
    assert {path.read_text(), *seen} <= {"a" * 10_000, "b" * 10_000}
    assert names(tmp_path) == ["plan"]


def hold_lock(path, ready):
    with lock(path) as locked:
        assert locked
        ready.set()
        signal.pause()


def test_a_lock_is_held_by_one_process_and_freed_by_its_death(tmp_path):
    """Two processes must not work on one run, and a killed one must not block it."""
    path, ready = tmp_path / "folder" / "lock", PREPARED.Event()
    assert not is_locked(path)
    holder = PREPARED.Process(target=hold_lock, args=(path, ready))
    holder.start()
    assert ready.wait(60)
    assert is_locked(path)
    assert lock_owner(path) == f"process {holder.pid} on {socket.gethostname()}"
    with lock(path) as locked:
        assert not locked
    holder.kill()
    with lock(path, wait=True) as locked:
        assert locked
        assert is_locked(path)
        with lock(path, wait=True) as again:  # waiting for itself would not end
            assert not again
        assert is_locked(path)
    holder.join()
    assert not is_locked(path)


def write_limited(kind, folder, answers):
    """Write 4 MB or more where files are limited to 0.5 MB, as on a full disk; runs in a separate
    process."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 19, 1 << 19))
    numbers = np.zeros(1 << 20, np.float32)
    content = {"weights": torch.from_numpy(numbers)}  # no threads after a fork
    write = {
        "text": lambda path: path.write_text("x" * (4 << 20)),
        "torch": lambda path: torch.save(content, path),
        "safetensors": lambda path: save_file(content, path),
    }
    try:
        if kind in write:
            write_atomically(folder / "last.ckpt", write[kind])
        with name_folder_in_errors(folder):
            np.save(folder / "a.npy", numbers)
    except BaseException as error:
        answers.put((type(error), str(error)))


@pytest.mark.parametrize(
    ("kind", "named", "left"),
    [
        ("text", "last.ckpt", []),
        ("torch", "last.ckpt", []),
        ("safetensors", "last.ckpt", []),
        ("numpy", "", ["a.npy"]),
    ],
)
def test_a_full_disk_is_reported_with_the_file_or_folder(tmp_path, kind, named, left):
    """Libraries hide the system's reason in errors of their own, without a path."""
    context = multiprocessing.get_context("fork")
    answers = context.Queue()
    process = context.Process(target=write_limited, args=(kind, tmp_path, answers))
    process.start()
    answer = answers.get(timeout=60)
    process.join(60)
    assert answer == (OSError, f"[Errno 27] File too large: '{tmp_path / named}'")
    assert names(tmp_path) == left


def test_errors_that_name_a_file_keep_it(tmp_path):
    with pytest.raises(FileNotFoundError) as caught, name_folder_in_errors(tmp_path):
        (tmp_path / "none").read_text()
    assert caught.value.filename == str(tmp_path / "none")


def test_a_bug_in_the_writer_keeps_its_type(tmp_path):
    """Only errors of the system are bad input."""
    with pytest.raises(KeyError, match="bug"):
        write_atomically(tmp_path / "x", lambda temporary: {}["bug"])


def link(path, content, kind="symlink"):
    """Link to a file with this content, stored elsewhere."""
    target = path.with_name(f"target-of-{path.name}")
    target.write_text(content)
    getattr(path, f"{kind}_to")(target)
    return target


@pytest.mark.parametrize("act", [lock, is_locked], ids=["lock", "is_locked"])
@pytest.mark.parametrize("kind", ["symlink", "hardlink"])
def test_a_lock_file_that_is_another_file_is_refused_and_stays(tmp_path, kind, act):
    """Untrusted folders may contain a ``.lock`` that leads to a file of the user."""
    target = link(tmp_path / ".lock", "precious", kind)
    with pytest.raises(InputError, match=r"\.lock: expected a lock file; found .*(link|another file)"):
        act(tmp_path / ".lock").__enter__()
    assert target.read_text() == "precious"


def test_a_lock_is_not_made_where_a_link_leads(tmp_path):
    """An empty or missing target would become a lock."""
    (tmp_path / ".lock").symlink_to(tmp_path / "target")
    for _ in range(2):
        with pytest.raises(InputError, match=r"\.lock: expected a lock file; found 'a link'"):
            lock(tmp_path / ".lock").__enter__()
        assert not (tmp_path / "target").exists() or not (tmp_path / "target").read_text()
        (tmp_path / "target").touch()


def test_a_lock_of_an_earlier_process_is_taken_also_through_a_linked_folder(tmp_path):
    """Results on another disk are linked, and a backup may share the lock file."""
    (tmp_path / "disk").mkdir()
    (tmp_path / "runs").symlink_to(tmp_path / "disk")
    link(tmp_path / "disk" / "lock", "process 4000000 on elsewhere\n", "hardlink")
    with lock(tmp_path / "runs" / "lock") as locked:
        assert locked
        assert is_locked(tmp_path / "disk" / "lock")
        assert lock_owner(tmp_path / "disk" / "lock") == f"process {os.getpid()} on {socket.gethostname()}"


@pytest.mark.parametrize("kind", ["a pipe", "a device", "links in a loop"])
def test_what_is_no_file_is_never_replaced(tmp_path, kind):
    """``out=/dev/null`` must not become a file, nor a pipe that another program reads."""
    path = tmp_path / "it"
    if kind == "a pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/null" if kind == "a device" else path)
    before = path.lstat()
    with pytest.raises((InputError, OSError), match=r"expected a file to write; found|symbolic links"):
        write_text_atomically(path, "text")
    assert path.lstat() == before
    assert names(tmp_path) == ["it"]


def test_a_link_is_replaced_and_its_file_stays(tmp_path):
    target = link(tmp_path / "a.ckpt", "old")
    write_text_atomically(tmp_path / "a.ckpt", "new")
    assert target.read_text() == "old"
    assert not (tmp_path / "a.ckpt").is_symlink()
    assert (tmp_path / "a.ckpt").read_text() == "new"


def test_one_rule_for_files_that_exist(tmp_path):
    require_free(tmp_path / "new", "out", overwrite=False)
    (tmp_path / "link").symlink_to(tmp_path / "nothing")
    (tmp_path / "old").touch()
    for name in ("old", "link"):
        with pytest.raises(
            InputError, match=r"^out: expected a path where there is no file, or overwrite=true"
        ):
            require_free(tmp_path / name, "out", overwrite=False)
        require_free(tmp_path / name, "out", overwrite=True)
    with pytest.raises(InputError, match="expected a file to write; found 'a directory'"):
        require_free(tmp_path, "out", overwrite=True)


@pytest.mark.parametrize("place", ["train.log", "csv", "csv/metrics.csv"])
def test_links_in_a_run_are_refused(tmp_path, place):
    """Lightning and logging open files in the run's directory without checks."""
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / "checkpoints").symlink_to(tmp_path)
    require_no_links(tmp_path, ("train.log", "csv"))
    link(tmp_path / place, "precious")
    with pytest.raises(InputError, match=f"{place}: expected a file or folder of the run; found 'a link'"):
        require_no_links(tmp_path, ("train.log", "csv"))


def test_a_folder_that_cannot_be_written_to_is_said_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(
        os, "access", lambda path, mode: str(path) != str(tmp_path)
    )  # root may write anywhere
    with pytest.raises(
        InputError, match=rf"^out: expected a folder that can be written to .*; found '{tmp_path}'"
    ):
        require_free(tmp_path / "new" / "a.ckpt", "out", overwrite=False)
