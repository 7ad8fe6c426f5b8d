"""Invalid commands of every verb: an exit code and a one-line message, never a traceback."""

import errno
import os
import resource
import shlex
import signal
import time
from unittest.mock import Mock

import pytest
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig

from ghgs_lit.weights.checkpoint import write_checkpoint
from ghgs_people import datasets
from tests.cli.bad_commands import ROWS
from tests.helpers.models import config, make_model
from tests.helpers.processes import start_verb
from tests.helpers.verbs import ghgs


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Files and folders by their names in rows."""
    folder = tmp_path_factory.mktemp("files")
    places = {name: folder / name for name in ("ckpt", "text", "empty", "list", "tensors", "hollow", "newer")}
    places["broken"] = folder / "broken"
    write_checkpoint(places["ckpt"], make_model().state_dict(), config())
    write_checkpoint(places["hollow"], {}, config())
    places["text"].write_text("no weights\n")
    places["empty"].mkdir()
    torch.save([1, 2], places["list"])
    torch.save({"weight": torch.zeros(2)}, places["tensors"])
    torch.save({"state_dict": {}, "config": {}, "format_version": 99}, places["newer"])
    places |= {"loop": folder / "loop", "yaml": folder / "yaml"}
    places["loop"].symlink_to(folder / "back")
    (folder / "back").symlink_to(places["loop"])
    (places["yaml"] / "views").mkdir(parents=True)
    (places["yaml"] / "encoder").mkdir()
    (places["yaml"] / "encoder" / "calls.yaml").write_text("kind: vggt\n_target_: os.system\n")
    (places["yaml"] / "views" / "cut.yaml").write_text("name: cut\ntraining_counts: [3\n")
    (places["yaml"] / "views" / "tagged.yaml").write_text("name: !!python/object/apply:os.getcwd []\n")
    (places["broken"] / "run").mkdir(parents=True)
    (places["broken"] / "run" / "metrics.json").write_text("{")
    return places


def call(monkeypatch, capfd, tmp_path, command: str) -> tuple[int, str]:
    """Exit code and standard error of ``ghgs <command>`` in the folder ``tmp_path``."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GHGS_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)
    # Rendering takes minutes, so every possible check must precede it.
    started = AssertionError("work started before all was checked")
    monkeypatch.setattr(datasets, "render_people", Mock(side_effect=started))
    GlobalHydra.instance().clear()
    code = ghgs(*shlex.split(command)) or 0
    out, err = capfd.readouterr()
    return code, err or out


@pytest.mark.parametrize(
    ("command", "expected", "parts"),
    [pytest.param(row[0], row[1], row[2:], id=row[0] or "nothing") for row in ROWS],
)
def test_a_bad_command_gets_its_exit_code_and_one_line(
    monkeypatch, capfd, tmp_path, files, command, expected, parts
):
    """The message contains the path or key, what was expected and what was found."""
    names = {**files, "tmp": tmp_path}
    code, text = call(monkeypatch, capfd, tmp_path, command.format(**names))
    assert code == expected, text
    assert "Traceback" not in text
    if command:  # without a verb, usage is printed
        assert len(text.strip().splitlines()) == 1, text
    for part in parts:
        assert part.format(**names) in text


@pytest.mark.parametrize(
    ("command", "number"),
    [
        ("train", errno.ENOSPC),
        ("evaluate data=synthetic", errno.EROFS),
        ("predict checkpoint={ckpt} data=synthetic", errno.EACCES),
        ("import out=x.ckpt", errno.EDQUOT),
        ("export checkpoint={ckpt} inference=x.pt", errno.ENOSPC),
        ("table runs={empty}", errno.EROFS),
    ],
)
def test_a_disk_that_refuses_a_file_is_one_line_with_its_path(
    monkeypatch, capfd, tmp_path, files, command, number
):
    """Regression: a full disk or a read-only folder ended in a traceback without the path."""

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "replace", refuse)
    code, text = call(monkeypatch, capfd, tmp_path, f"{command.format(**files)} hydra.run.dir={tmp_path}/run")
    verb = command.split()[0]
    assert code == 1, text
    expected = f"expected a file or folder that can be read or written; found {os.strerror(number)}\n"
    assert text.startswith(f"ghgs {verb}: {tmp_path}/run/")
    assert text.endswith(expected)


def test_weights_that_do_not_fit_the_disk_are_one_line_with_their_path(monkeypatch, capfd, tmp_path, files):
    """PyTorch reports a full disk with its own error; here files are limited to 64 KiB."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, before[1]))
    try:
        path = tmp_path / "encoder.pt"
        code, text = call(monkeypatch, capfd, tmp_path, f"export checkpoint={files['ckpt']} inference={path}")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert code == 1, text
    expected = "expected a file or folder that can be read or written; found File too large"
    assert text == f"ghgs export: {path}: {expected}\n"
    assert not path.exists()


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (signal.SIGINT, 130),
        (signal.SIGTERM, 143),
    ],
)
def test_a_signal_is_an_exit_code_and_one_line(tmp_path, number, expected):
    """Scripts and batch systems distinguish interrupted, failed and successful verbs."""
    command = "ghgs prepare data.people.train=5000 data.render_workers=0"
    command += f" data.cache_dir={tmp_path / 'cache'} hydra.run.dir={tmp_path / 'run'}"
    process, output = start_verb(command, tmp_path, os.environ)
    try:
        for _ in range(1200):
            if any(tmp_path.glob("cache/*/*")) or not process.is_alive():
                break
            time.sleep(0.1)
        os.kill(process.pid, number)
        process.join(60)
    finally:
        process.kill()
    text = output.read_text()
    assert process.exitcode == expected, text
    assert "Traceback" not in text
    assert text.strip().splitlines()[-1].startswith("ghgs prepare: ")


def test_a_working_directory_that_is_gone(monkeypatch, capfd, tmp_path):
    """A job whose folder has been deleted; help works without a working directory."""
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    expected = ".: expected a file or folder that can be read or written; found No such file or directory\n"
    for command, code in (("doctor task=machine", 1), ("train -m seed=1,2", 1), ("--help", 0)):
        assert ghgs(*command.split()) == code
        error = capfd.readouterr().err
        assert error == (f"ghgs {command.split()[0]}: {expected}" if code else "")
