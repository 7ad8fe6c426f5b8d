"""Run code in a fresh interpreter, or in a fork of one with all imports."""

import multiprocessing
import os
import runpy
import shlex
import subprocess
import sys
from collections.abc import Callable, Mapping
from multiprocessing.process import BaseProcess
from pathlib import Path

#: Forks processes from one without threads that has done all slow imports.
PREPARED = multiprocessing.get_context("forkserver")
PREPARED.set_forkserver_preload(
    [
        "pytest",
        "tests.helpers.composing",
        *(f"ghgs_lit.cli.{name}" for name in ("application", "prepare", "train", "predict", "table")),
    ]
)


def run_python(code: str, expected: int = 0, **variables: str) -> subprocess.CompletedProcess:
    """Run ``code`` in a process with these environment variables; it must end with exit code ``expected``."""
    path = os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])
    # Tests of commands set this variable in the parent process.
    before = {name: value for name, value in os.environ.items() if name != "HYDRA_FULL_ERROR"}
    environment = {**before, "PYTHONPATH": path, **variables}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == expected, done.stderr
    return done


def run_prepared(function: Callable, *arguments: object) -> None:
    """Call a function of a module in a process of :data:`PREPARED`; it must succeed."""
    process = PREPARED.Process(target=function, args=arguments)
    process.start()
    process.join(300)
    process.kill()  # if it hangs
    assert process.exitcode == 0


def run_verb(command: str, folder: Path, environment: Mapping[str, str]) -> tuple[int, str]:
    """Run ``ghgs ...`` in a folder, as a process of :data:`PREPARED`; return exit code and output."""
    return _ended(*start_verb(command, folder, environment))


def run_block(code: str, folder: Path, environment: Mapping[str, str]) -> tuple[int, str]:
    """Run ``python -c <code>`` like :func:`run_verb`."""
    return _ended(*_started(folder, environment, _block, code))


def run_script(command: str, folder: Path, environment: Mapping[str, str]) -> tuple[int, str]:
    """Run ``python <path> ...`` like :func:`run_verb`."""
    return _ended(*_started(folder, environment, _script, shlex.split(command)[1:]))


def start_verb(command: str, folder: Path, environment: Mapping[str, str]) -> tuple[BaseProcess, Path]:
    """Start the process of :func:`run_verb`; return it and the file of its output."""
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
    process.kill()  # if it hangs
    return process.exitcode, output.read_text()


def _called_in(
    folder: Path, environment: dict[str, str], output: Path, function: Callable, given: object
) -> None:
    # As in a fresh process, whose children preload nothing.
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
