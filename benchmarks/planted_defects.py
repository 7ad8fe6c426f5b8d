"""Defects planted one at a time in a copy of the package, and the tests that catch them.

    python benchmarks/planted_defects.py                # all, some seconds each
    python benchmarks/planted_defects.py rounds/ seed   # those whose file or description has one of the words

``planted_defects.json`` lists the defects: what is wrong, the file of the package, the text before and
after, and the tests (files or ids) or the stage of ``ghgs stress`` that must fail with it and pass without.
Prints what catches each and the score; exit code 1 where a defect is not caught.
"""

import json
import multiprocessing
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_suffix(".json")
#: Copied. Caches of kernels are, too: they are stamped with their sources, and compiling takes a minute.
COPIED = ("ghgs_lit", "hydra_plugins", "conf", "tests", "benchmarks", "scripts", "examples", "pyproject.toml")
#: What tests take seconds to import, and is not ours.
LOADED = ("pytest", "torch", "lightning.pytorch", "kornia", "hydra", "pandas", "scipy.spatial", "trimesh")


@dataclass(frozen=True)
class Defect:
    """What is wrong, the changed text of ``file``, and the tests or the stage that must notice."""

    says: str
    file: str
    before: str
    after: str
    tests: tuple[str, ...] = ()
    stage: str | None = None

    @property
    def room(self) -> str:
        """The part of the package."""
        return self.file.split("/")[0].removesuffix(".py")

    def has(self, words: list[str]) -> bool:
        """Whether the file or the description has one of the words; none: True."""
        return not words or any(word in self.file or word in self.says for word in words)

    def planted(self, text: str) -> str:
        """The file's text with the defect.

        Raises:
            ValueError: the text before does not stand there exactly once, or changes nothing.
        """
        if text.count(self.before) != 1 or self.before == self.after:
            raise ValueError(f"{self.file} ({self.says}): expected once: {self.before!r}")
        return text.replace(self.before, self.after)


def defects() -> list[Defect]:
    """Those of the list."""
    return [Defect(**{**one, "tests": tuple(one.get("tests", ()))}) for one in json.loads(LIST.read_text())]


class _Failures:
    """A plugin of pytest that notes the ids of tests that fail, and of files that cannot be read."""

    def __init__(self):
        self.ids: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.ids += [report.nodeid] * report.failed

    pytest_collectreport = pytest_runtest_logreport


def _run_tests(copy: Path, tests: list[str], results: Connection) -> None:
    """Send pytest's exit code and the failures of a run on the copy."""
    os.chdir(copy)
    silence, failures = os.open(os.devnull, os.O_WRONLY), _Failures()
    for stream in (1, 2):
        os.dup2(silence, stream)
    code = pytest.main(["-x", "--tb=no", "-p", "no:cacheprovider", *tests], plugins=[failures])
    results.send((int(code), failures.ids))


def failing_tests(copy: Path, tests: list[str]) -> list[str]:
    """Ids of the tests that fail in ``copy``, up to the first; a file that cannot be read is one, too.

    A process of its own runs them, forked from one that has loaded the packages that ours needs.
    """
    results, sent = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("forkserver").Process(target=_run_tests, args=(copy, tests, sent))
    process.start()
    sent.close()
    try:
        code, failed = results.recv()
    except EOFError:
        code, failed = 1, ["a process that ended"]
    process.join()
    if code not in (0, 1, 2) or bool(code) != bool(failed):
        raise SystemExit(f"pytest {' '.join(tests)}: exit code {code}")
    return failed


def failing_families(copy: Path, stage: str) -> list[str]:
    """Families of inputs with which a stage fails in a quick run of the stress test on ``copy``."""
    out = copy / "out"
    shutil.rmtree(out, ignore_errors=True)
    settings = ("quick=true", "workers=0", f"stages=[{stage}]", f"hydra.run.dir={out}")
    command = [sys.executable, "-m", "ghgs_lit", "stress", *settings]
    done = subprocess.run(command, cwd=copy, capture_output=True, text=True)
    if not (out / "stress.json").exists():
        raise SystemExit(done.stdout + done.stderr)
    cells = json.loads((out / "stress.json").read_text())["cells"]
    return list(dict.fromkeys(f"{stage}: {cell['family']}" for cell in cells if cell["failures"]))


def caught_by(copy: Path, defect: Defect) -> list[str]:
    """What fails with the defect."""
    path = copy / "ghgs_lit" / defect.file
    text = path.read_text()
    path.write_text(defect.planted(text))
    try:
        if defect.stage:
            return failing_families(copy, defect.stage)
        return failing_tests(copy, list(defect.tests))
    finally:
        path.write_text(text)


def main(words: list[str]) -> None:
    chosen = [defect for defect in defects() if defect.has(words)]
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "copy"
        copy.mkdir()
        # Python's own caches know a changed file by the second only.
        os.environ |= {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
        multiprocessing.set_forkserver_preload(list(LOADED))
        for path in (ROOT / name for name in COPIED):
            if path.is_dir():
                shutil.copytree(path, copy / path.name, ignore=shutil.ignore_patterns("*.pyc"))
            else:
                shutil.copy(path, copy)
        tests = sorted({test for defect in chosen for test in defect.tests})
        before = failing_tests(copy, tests) if tests else []
        for stage in sorted({defect.stage for defect in chosen if defect.stage}):
            before += failing_families(copy, stage)
        if before:
            raise SystemExit(f"without a defect: {before} fail")
        print("| defect | file | caught by |\n|---|---|---|")
        caught, planted = Counter(), Counter(defect.room for defect in chosen)
        for defect in chosen:
            failed = caught_by(copy, defect)
            caught[defect.room] += bool(failed)
            print(f"| {defect.says} | `{defect.file}` | {', '.join(failed) or 'NOTHING'} |", flush=True)
    print(", ".join(f"{room} {caught[room]}/{count}" for room, count in planted.items()))
    print(f"caught: {caught.total()} of {planted.total()}")
    raise SystemExit(int(caught.total() < planted.total()))


if __name__ == "__main__":
    main(sys.argv[1:])
