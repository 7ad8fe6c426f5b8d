"""Running code in a fresh interpreter, or in a fork of one that has imported all."""

import multiprocessing
import os
import runpy
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from multiprocessing.process import BaseProcess
from pathlib import Path

#: Makes processes by forking one that runs no threads and has imported what takes seconds.
PREPARED = multiprocessing.get_context("forkserver")
PREPARED.set_forkserver_preload(
    [
        "pytest",
        "tests.helpers.composing",
        *(f"ghgs_lit.cli.{name}" for name in ("application", "prepare", "train", "predict", "table")),
    ]
)


def run_python(code: str, expected: int = 0, **variables: str) -> subprocess.CompletedProcess:
    """``code``, which must end with exit code ``expected``, in a process with these variables."""
    path = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    # Where a user has not set it: tests of commands in this process have.
    before = {name: value for name, value in os.environ.items() if name != "HYDRA_FULL_ERROR"}
    environment = {**before, "PYTHONPATH": path, **variables}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == expected, done.stderr
    return done


def run_prepared(function: Callable, *arguments: object) -> None:
    """Call a function of a module, which must succeed, in a process of :data:`PREPARED`."""
    process = PREPARED.Process(target=function, args=arguments)
    process.start()
    process.join(300)
    process.kill()  # where it hangs
    assert process.exitcode == 0


def run_verb(command: str, folder: Path, environment: Mapping[str, str]) -> tuple[int, str]:
    """Exit code and output of ``ghgs ...`` in a folder, as a process of :data:`PREPARED`."""
    return _ended(*start_verb(command, folder, environment))


def run_block(code: str, folder: Path, environment: Mapping[str, str]) -> tuple[int, str]:
    """The same of ``python -c <code>``."""
    return _ended(*_started(folder, environment, _block, code))


def run_script(command: str, folder: Path, environment: Mapping[str, str]) -> tuple[int, str]:
    """The same of ``python <path> ...``."""
    return _ended(*_started(folder, environment, _script, shlex.split(command)[1:]))


def start_verb(command: str, folder: Path, environment: Mapping[str, str]) -> tuple[BaseProcess, Path]:
    """The process of :func:`run_verb`, and the file that its output goes to."""
    return _started(folder, environment, _verb, shlex.split(command))


def _started(
    folder: Path, environment: Mapping[str, str], function: Callable, given: object
) -> tuple[BaseProcess, Path]:
    output = folder / ".output"
    process = PREPARED.Process(target=_called_in, args=(folder, dict(environment), output, function, given))
    process.start()
    return process, output


def _ended(process: BaseProcess, output: Path) -> tuple[int, str]:
    process.join(300)
    process.kill()  # where it hangs
    return process.exitcode, output.read_text()


def _called_in(
    folder: Path, environment: dict[str, str], output: Path, function: Callable, given: object
) -> None:
    # As in a fresh process, whose own processes import nothing more for these tests.
    multiprocessing.set_start_method(None, force=True)
    PREPARED.set_forkserver_preload(["__main__"])
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    with open(output, "w") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    function(given)


def _verb(argv: list[str]) -> None:
    from ghgs_lit.cli.main import main

    sys.argv = argv
    sys.exit(main())


def _script(argv: list[str]) -> None:
    sys.argv = argv
    sys.path.insert(0, str(Path(argv[0]).parent.resolve()))
    runpy.run_path(argv[0], run_name="__main__")


def _block(code: str) -> None:
    exec(code, {"__name__": "__main__"})
