"""Start and end of commands: imports that they avoid, and what still happens at exit."""

import os
import signal
import sys

import pytest

from ghgs_lit.cli.main import main
from ghgs_lit.config import registry
from ghgs_lit.runs.processes import handlers
from tests.helpers.processes import run_python

_COMMAND = """
import sys
from ghgs_lit.cli.main import main
sys.argv = ["ghgs", *{arguments}]
try:
    code = main()
except SystemExit as stop:
    code = stop.code
print("\\n", code, *sys.modules)
"""


@pytest.mark.parametrize(
    ("arguments", "code", "absent"),
    [
        (["--help"], 0, {"torch", "numpy"}),
        (["predict", "--help"], 0, {"torch", "numpy"}),
        (["predict", "images=nowhere", "cameras=nowhere.json"], 1, {"torch", "scipy"}),
        (["predict", "checkpoint=nowhere.ckpt"], 1, {"torch", "scipy"}),
        (["doctor", "images=nowhere", "cameras=nowhere.json"], 1, {"torch", "scipy"}),
        (["evaluate", "checkpoint=nowhere.ckpt"], 1, {"torch", "scipy"}),
        (["train", "resume=nowhere.ckpt"], 1, {"torch", "scipy"}),
        (["train", "data=scans", "data.root=nowhere"], 1, {"torch", "scipy"}),
    ],
)
def test_help_and_wrong_paths_do_not_wait_for_pytorch(tmp_path, arguments, code, absent):
    """Importing PyTorch takes a second or more."""
    arguments = [*arguments, f"hydra.run.dir={tmp_path}/run"] if code else arguments
    done = run_python(_COMMAND.format(arguments=arguments))
    found, *loaded = done.stdout.splitlines()[-1].split()
    assert int(found) == code
    assert ("nowhere" in done.stderr) == bool(code)
    assert not absent & set(loaded)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_is_stopped_while_it_starts_says_so(monkeypatch, capsys, number):
    """Regression: Ctrl-C during imports ended in a traceback or in an error of the library."""

    def interrupted():
        try:
            os.kill(os.getpid(), number)
        finally:
            raise ImportError("cannot import name 'x' from partially initialized module")

    monkeypatch.setattr(registry, "verbs", interrupted)
    monkeypatch.setattr(sys, "argv", ["ghgs", "greet", "-m"])
    before = handlers()
    assert main() == 128 + number
    assert capsys.readouterr().err == f"ghgs greet: interrupted ({signal.Signals(number).name})\n"
    assert handlers() == before


_ENDING = """
import atexit, os, sys
from ghgs_lit.cli.main import main
from ghgs_lit.errors import InputError

class Cycle:
    def __init__(self):
        self.itself = self

    def __del__(self, write=os.write):
        write(2, b"collected")

class Module:
    @staticmethod
    def run(options):
        atexit.register(print, "hook")
        Cycle()
        print("said", end=" ")
        if {fails}:
            raise InputError("file: expected one; found none")

sys.modules["ghgs_lit.cli.{verb}"] = Module
sys.argv = ["ghgs", "{verb}", "{override}", "hydra.run.dir={folder}/run"]
sys.exit(main())
"""


@pytest.mark.parametrize("fails", [False, True])
def test_a_command_ends_as_python_does(tmp_path, fails):
    """Exit hooks run, output is flushed, and the remains of a run are collected."""
    code = _ENDING.format(verb="table", override="runs=x", fails=fails, folder=tmp_path)
    done = run_python(code, expected=int(fails))
    assert done.stdout == "said hook\n"
    assert done.stderr == "ghgs table: file: expected one; found none\n" * fails + "collected"


def test_files_that_a_plug_in_leaves_open_are_whole(tmp_path):
    """Frozen objects in a cycle are not flushed; a module and its functions form one."""
    plugin, path = tmp_path / "my_unprojection.py", tmp_path / "file.txt"
    plugin.write_text(
        "from ghgs_lit.config import register\n"
        "from ghgs_lit.geometry.unprojection import Unprojection\n"
        f"file = open({str(path)!r}, 'w')\n"
        "file.write('flushed')\n"
        "@register('unprojection', 'mine')\n"
        "class Mine(Unprojection):\n"
        "    pass\n"
        "def cycle():\n"
        "    pass\n"
    )
    code = _ENDING.format(verb="train", override="unprojection.kind=mine", fails=False, folder=tmp_path)
    assert run_python(code, GHGS_PLUGINS=str(plugin)).stdout == "said hook\n"
    assert path.read_text() == "flushed"
