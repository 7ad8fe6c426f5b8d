"""Defects planted one at a time in a copy of the packages, and the tests that catch them.

    python benchmarks/planted_defects.py                # all, some seconds each
    python benchmarks/planted_defects.py rounds/ seed   # those whose file or description has one of the words

Each line of ``planted_defects.json`` is a defect:

- ``what`` is wrong;
- ``at``: the end of the dotted name of a function, method, class or constant, as long as one has it
  (``rig.known_as``), so that files and packages may move;
- ``change``: one expression or statement of its code and what replaces it, as ``A - B → B - A``.
  Both are Python; ``A`` to ``D`` stand for any expression. Code is compared as a syntax tree, so
  that line breaks and formatting do not matter;
- ``test``: the end of the dotted name of a test (``test_rig.test_gains_are_bounded``, with the id
  of one case in brackets) or of a file of tests. It must fail with the defect and pass without.

Prints what catches each and the score; exit code 1 where a defect is not caught.
"""

import ast
import json
import multiprocessing
import os
import re
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LIST = Path(__file__).with_suffix(".json")
#: Copied. Caches of kernels are, too: they are stamped with their sources,
#: and compiling takes a minute.
COPIED = ("ghgs_*", "hydra_plugins", "conf", "tests", "benchmarks", "scripts", "examples", "pyproject.toml")
#: What tests take seconds to import, and is not ours.
LOADED = ("pytest", "torch", "lightning.pytorch", "kornia", "hydra", "pandas", "scipy.spatial", "trimesh")
#: Names that stand for any expression in a change.
ANY = ("A", "B", "C", "D")
CODE = "ghgs_*/**/*.py"
TESTS = "tests/**/test_*.py"


def definitions(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, ast.stmt]]:
    """Names and nodes of functions, classes,
    methods and constants of a module's or a class's body."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield prefix + node.name, node
        if isinstance(node, ast.ClassDef):
            yield from definitions(node.body, f"{prefix}{node.name}.")
        if isinstance(node, ast.Assign | ast.AnnAssign):
            yield prefix + ast.unparse(getattr(node, "target", None) or node.targets[0]), node


@cache
def _names(files: str) -> dict[str, tuple[str, str]]:
    """File and name in the file of each dotted name; that of a module itself is empty."""
    names = {}
    for path in ROOT.glob(files):
        file = path.relative_to(ROOT)
        module = ".".join(file.with_suffix("").parts).removesuffix(".__init__")
        names[module] = str(file), ""
        for name, _ in definitions(ast.parse(path.read_text()).body):
            names[f"{module}.{name}"] = str(file), name
    return names


def found(files: str, end: str) -> tuple[str, str]:
    """File and name in it of the one definition whose dotted name ends with ``end``.

    Raises:
        ValueError: none has it, or several.
    """
    fitting = [name for name in _names(files) if f".{name}".endswith(f".{end}")]
    if len(fitting) != 1:
        raise ValueError(f"{end}: expected the end of one name in {files}; found {fitting or 'none'}")
    return _names(files)[fitting[0]]


def _fits(pattern: object, node: object, bound: dict[str, ast.expr]) -> bool:
    """Whether code is that of a pattern; notes in ``bound`` what its ``ANY`` stand for."""
    if isinstance(pattern, ast.Name) and pattern.id in ANY and isinstance(node, ast.expr):
        return (
            _fits(bound[pattern.id], node, {})
            if pattern.id in bound
            else bool(bound.setdefault(pattern.id, node))
        )
    if type(pattern) is not type(node):
        return False
    if isinstance(pattern, list):
        return len(pattern) == len(node) and all(
            _fits(*pair, bound) for pair in zip(pattern, node, strict=True)
        )
    if isinstance(pattern, ast.AST):
        fields = [name for name in pattern._fields if name != "ctx"]
        return all(_fits(getattr(pattern, name), getattr(node, name), bound) for name in fields)
    return pattern == node


class _Change(ast.NodeTransformer):
    """Replaces code that fits the left side of ``before → after``, and counts it."""

    def __init__(self, change: str):
        before, self.after = change.split(" → ")
        statement = ast.parse(before).body[0]
        self.before = statement.value if isinstance(statement, ast.Expr) else statement
        self.count = 0

    def visit(self, node: ast.AST) -> ast.AST:
        bound: dict[str, ast.expr] = {}
        if not _fits(self.before, node, bound):
            return self.generic_visit(node)
        self.count += 1
        after = re.sub(r"\b[A-D]\b", lambda name: f"({ast.unparse(bound[name[0]])})", self.after)
        statement = ast.parse(after).body[0]
        return statement.value if isinstance(node, ast.expr) else statement


def change_code(code: ast.AST, change: str) -> None:
    """Change code in place, by ``before → after``.

    Raises:
        ValueError: it does not have what is changed exactly once, or would stay the same.
    """
    transformer, before = _Change(change), ast.dump(code)
    transformer.visit(code)
    if transformer.count != 1 or ast.dump(code) == before:
        raise ValueError(f"{change}: expected once, and a change; found {transformer.count} times")


@dataclass(frozen=True)
class Defect:
    """A line of the list."""

    what: str
    at: str
    change: str
    test: str

    @property
    def file(self) -> str:
        """The file to change."""
        return found(CODE, self.at)[0]

    @property
    def test_id(self) -> str:
        """The test, as pytest names it."""
        name, bracket, case = self.test.partition("[")
        path, name = found(TESTS, name)
        return "::".join(filter(None, (path, *name.split(".")))) + bracket + case

    def planted(self, text: str) -> str:
        """The file's code with the defect. ValueError: as from :func:`change_code`."""
        tree = ast.parse(text)
        change_code(dict(definitions(tree.body))[found(CODE, self.at)[1]], self.change)
        return ast.unparse(tree)


def defects() -> list[Defect]:
    """Those of the list."""
    return [Defect(**one) for one in json.loads(LIST.read_text())]


class _Failures:
    """A plugin of pytest that notes the ids of tests that fail,
    and of files that cannot be read."""

    def __init__(self):
        self.ids: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.ids += [report.nodeid] * report.failed

    pytest_collectreport = pytest_runtest_logreport


def _run_tests(copied: Path, tests: list[str], results: Connection) -> None:
    """Send pytest's exit code and the failures of a run on the copy."""
    os.chdir(copied)
    silence, failures = os.open(os.devnull, os.O_WRONLY), _Failures()
    for stream in (1, 2):
        os.dup2(silence, stream)
    code = pytest.main(["-x", "--tb=no", "-p", "no:cacheprovider", *tests], plugins=[failures])
    results.send((int(code), failures.ids))


def failing_tests(copied: Path, tests: list[str]) -> list[str]:
    """Ids of the tests that fail in a copy, up to the first;
    a file that cannot be read is one, too.

    A process of its own runs them, forked from one that has loaded the packages that ours needs.
    """
    results, sent = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("forkserver").Process(target=_run_tests, args=(copied, tests, sent))
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


def caught_by(copied: Path, defect: Defect) -> list[str]:
    """What fails with the defect."""
    path = copied / defect.file
    text = path.read_text()
    path.write_text(defect.planted(text))
    try:
        return failing_tests(copied, [defect.test_id])
    finally:
        path.write_text(text)


def main(words: list[str]) -> None:
    chosen = [
        one for one in defects() if not words or any(word in one.file + " " + one.what for word in words)
    ]
    with tempfile.TemporaryDirectory() as folder:
        copied = Path(folder) / "copy"
        copied.mkdir()
        # Python's own caches know a changed file by the second only.
        os.environ |= {"PYTHONPATH": str(copied), "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
        os.environ["TRITON_INTERPRET"] = "1"  # read when Triton is imported
        multiprocessing.set_forkserver_preload(list(LOADED))
        for path in (path for name in COPIED for path in ROOT.glob(name)):
            if path.is_dir():
                shutil.copytree(path, copied / path.name, ignore=shutil.ignore_patterns("*.pyc"))
            else:
                shutil.copy(path, copied)
        if before := failing_tests(copied, sorted({one.test_id for one in chosen})):
            raise SystemExit(f"without a defect: {before} fail")
        print("| defect | in | caught by |\n|---|---|---|")
        caught, planted = Counter(), Counter()
        for defect in chosen:
            failed, room = (
                caught_by(copied, defect),
                "/".join(Path(defect.file).parts[:2]).removesuffix(".py"),
            )
            caught[room] += bool(failed)
            planted[room] += 1
            print(f"| {defect.what} | `{defect.at}` | {', '.join(failed) or 'NOTHING'} |", flush=True)
    print(", ".join(f"{room} {caught[room]}/{count}" for room, count in planted.items()))
    print(f"caught: {caught.total()} of {planted.total()}")
    raise SystemExit(int(caught.total() < planted.total()))


if __name__ == "__main__":
    main(sys.argv[1:])
