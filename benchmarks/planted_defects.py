"""Defects planted one at a time in a copy of the package, and the tests that catch them.

    python benchmarks/planted_defects.py                # all, some 15 seconds each
    python benchmarks/planted_defects.py rounds/ seed   # those whose file or description has one of the words

``planted_defects.json`` lists the defects: what is wrong, the file of the package, the text before and
after, and the tests (files or ids) or the stage of ``ghgs stress`` that must fail with it and pass without.
Prints what catches each and the score; exit code 1 where a defect is not caught.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_suffix(".json")
#: Copied. Caches of kernels are, too: they are stamped with their sources, and compiling takes a minute.
COPIED = ("ghgs_lit", "hydra_plugins", "conf", "tests", "benchmarks", "examples", "pyproject.toml")


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


def failing_tests(copy: Path, tests: list[str]) -> list[str]:
    """Ids of the tests that fail in ``copy``; a test file that cannot be read is one, too."""
    done = _python(copy, "pytest", "-x", "--tb=no", "-rfE", "-p", "no:cacheprovider", *tests)
    if done.returncode == 0:
        return []
    failed = [line.split()[1] for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    if not failed:
        raise SystemExit(done.stdout + done.stderr)
    return failed


def failing_families(copy: Path, stage: str) -> list[str]:
    """Families of inputs with which a stage fails in a quick run of the stress test on ``copy``."""
    out = copy / "out"
    shutil.rmtree(out, ignore_errors=True)
    settings = ("quick=true", "workers=0", f"stages=[{stage}]", f"hydra.run.dir={out}")
    done = _python(copy, "ghgs_lit", "stress", *settings)
    if not (out / "stress.json").exists():
        raise SystemExit(done.stdout + done.stderr)
    cells = json.loads((out / "stress.json").read_text())["cells"]
    return list(dict.fromkeys(f"{stage}: {cell['family']}" for cell in cells if cell["failures"]))


def _python(copy: Path, module: str, *arguments: str) -> subprocess.CompletedProcess:
    """A module run on the copy. Python's own caches are not written: they know changes by the second."""
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-m", module, *arguments]
    return subprocess.run(command, cwd=copy, capture_output=True, text=True, env=environment)


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
