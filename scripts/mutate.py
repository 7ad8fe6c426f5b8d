"""Measure the power of the tests: plant operator mutants and count those that tests kill.

    python scripts/mutate.py cover            # the suite once: which tests run each line
    python scripts/mutate.py run --count 300  # mutants; goes on where it was stopped
    python scripts/mutate.py table            # killed by package

A mutant changes one operator, constant, condition, statement or pair of arguments of a statement
drawn at random from all packages. The tests that run its line are tried, fastest first, until one
fails. Statements that coverage does not see (compiled kernels, module level) are tried with the
tests that run other lines of their file, or else of their package. Results lie in ``.mutants``.
"""

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("ghgs_lit", "ghgs_capture", "ghgs_people")
SWAPS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.MatMult: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
    ast.And: ast.Or, ast.Or: ast.And, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip
DROPPED = (ast.Expr, ast.AugAssign, ast.Raise)
#: What a change of would test nothing: annotations, decorators, docstrings.
SKIPPED = {"annotation", "returns", "decorator_list", "type_params"}


class Mutant(NamedTuple):
    """A change of one file.

    Attributes:
        path: of the file, from the checkout.
        line: first line of the changed code.
        kind: such as ``comparison``.
        before: code that is replaced.
        after: code that replaces it.
        start: position of ``before`` in the file, in characters.
    """

    path: str
    line: int
    kind: str
    before: str
    after: str
    start: int


def changes_of(node: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """Kinds and replacements of one node."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        swapped = [SWAPS[type(node.ops[0])](), *node.ops[1:]]
        yield "comparison", ast.Compare(node.left, swapped, node.comparators)
    if isinstance(node, ast.BinOp) and type(node.op) in SWAPS:
        yield "arithmetic", ast.BinOp(node.left, SWAPS[type(node.op)](), node.right)
    if isinstance(node, ast.BoolOp):
        yield "condition", ast.BoolOp(SWAPS[type(node.op)](), node.values)
    if isinstance(node, ast.If | ast.IfExp | ast.While):
        yield "condition", ast.UnaryOp(ast.Not(), node.test)
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
        number = node.value * 2 if abs(node.value) > 1 else node.value + 1
        yield "constant", ast.Constant(not node.value if isinstance(node.value, bool) else number)
    if isinstance(node, ast.Call) and len(node.args) > 1:
        first, second, *others = node.args
        if not any(isinstance(argument, ast.Starred) for argument in (first, second)):
            yield "arguments", ast.Call(node.func, [second, first, *others], node.keywords)
    if isinstance(node, DROPPED):
        yield "statement", ast.Pass()


def own_nodes(statement: ast.stmt) -> Iterator[ast.AST]:
    """Nodes of a statement without those of the statements within it."""
    yield statement
    waiting = [statement]
    while waiting:
        for name, value in ast.iter_fields(waiting.pop()):
            for child in value if isinstance(value, list) else [value]:
                if isinstance(child, ast.AST) and not isinstance(child, ast.stmt) and name not in SKIPPED:
                    waiting.append(child)
                    yield child


def mutants_of(path: Path) -> list[list[Mutant]]:
    """Mutants of a file, by statement."""
    text = path.read_text()
    lines = text.splitlines(keepends=True)

    def position(line: int, column: int) -> int:
        before = lines[line - 1].encode()[:column].decode()
        return sum(map(len, lines[: line - 1])) + len(before)

    found = []
    for statement in (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.stmt)):
        if isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant):
            continue
        mutants = []
        for node in own_nodes(statement):
            for kind, changed in changes_of(node):
                replaced = node.test if isinstance(node, ast.If | ast.IfExp | ast.While) else node
                start = position(replaced.lineno, replaced.col_offset)
                before = text[start : position(replaced.end_lineno, replaced.end_col_offset)]
                code = ast.unparse(ast.fix_missing_locations(changed))
                after = code if isinstance(changed, ast.stmt) else f"({code})"
                mutants.append(
                    Mutant(str(path.relative_to(ROOT)), replaced.lineno, kind, before, after, start)
                )
        if mutants:
            found.append(mutants)
    return found


def sample(count: int, seed: int) -> list[Mutant]:
    """Mutants of statements drawn from all packages; a longer sample begins with a shorter one."""
    files = (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py")))
    statements = [mutants for path in files for mutants in mutants_of(path)]
    generator = random.Random(seed)
    generator.shuffle(statements)
    return [generator.choice(mutants) for mutants in statements][:count]


def cover(folder: Path, tests: list[str]) -> None:
    """Run the tests and store the lines that each of them runs, and its seconds."""
    import coverage
    import pytest

    measured = coverage.Coverage(data_file=None, source=[str(ROOT / p) for p in PACKAGES], config_file=False)
    seconds: dict[str, float] = defaultdict(float)

    class Contexts:
        def pytest_runtest_logstart(self, nodeid: str) -> None:
            measured.switch_context(nodeid.split("[")[0])

        def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
            seconds[report.nodeid.split("[")[0]] += report.duration

    measured.start()
    pytest.main(["-q", "-p", "no:cacheprovider", *tests], plugins=[Contexts()])
    measured.stop()
    data = measured.get_data()
    lines = {}
    for file in data.measured_files():
        by_line = data.contexts_by_lineno(file)
        lines[str(Path(file).relative_to(ROOT))] = {n: sorted(filter(None, t)) for n, t in by_line.items()}
    text = json.dumps({"seconds": seconds, "lines": lines})
    (folder / "coverage.json").write_text(text)


def tests_of(mutant: Mutant, covered: dict, limit: float) -> list[str]:
    """Tests that may kill a mutant, fastest first, of at most ``limit`` seconds together."""
    lines, seconds = covered["lines"], covered["seconds"]
    package = str(Path(mutant.path).parent)
    of_file = lines.get(mutant.path, {})
    of_package = [by_line for path, by_line in lines.items() if path.startswith(package)]
    tests = set(of_file.get(str(mutant.line), []))
    for candidates in ([of_file], of_package):
        tests = tests or {test for by_line in candidates for names in by_line.values() for test in names}
    chosen, total = [], 0.0
    for test in sorted(tests, key=seconds.__getitem__):
        total += seconds[test]
        if chosen and total > limit:
            break
        chosen.append(test)
    return chosen


def outcome_of(mutant: Mutant, tests: list[str], copy: Path, limit: float) -> str:
    """``killed``, ``survived`` or ``not covered``."""
    if not tests:
        return "not covered"
    path = copy / mutant.path
    text = path.read_text()
    path.write_text(text[: mutant.start] + mutant.after + text[mutant.start + len(mutant.before) :])
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"}
    if "numba" in text or "compile" in text:
        environment["NUMBA_CACHE_DIR"] = str(copy / "mutated_kernels")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests]
    try:
        run = subprocess.run(command, cwd=copy, env=environment, capture_output=True, timeout=120 + 5 * limit)
        return "survived" if run.returncode == 0 else "killed"
    except subprocess.TimeoutExpired:
        return "killed"
    finally:
        path.write_text(text)
        shutil.rmtree(copy / "mutated_kernels", ignore_errors=True)


def run(folder: Path, count: int, seed: int, limit: float) -> None:
    """Try mutants and append their outcomes to ``outcomes.jsonl``; those there are not tried again."""
    covered = json.loads((folder / "coverage.json").read_text())
    outcomes = folder / "outcomes.jsonl"
    done = len(outcomes.read_text().splitlines()) if outcomes.exists() else 0
    copy = folder / "copy"
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, check=True, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        (copy / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, copy / name)
    for index, mutant in enumerate(sample(count, seed)[done:], done + 1):
        outcome = outcome_of(mutant, tests_of(mutant, covered, limit), copy, limit)
        print(f"{index} of {count}: {mutant.path}:{mutant.line} {mutant.kind}: {outcome}", flush=True)
        with open(outcomes, "a") as file:
            file.write(json.dumps({**mutant._asdict(), "outcome": outcome}) + "\n")


def table(folder: Path) -> None:
    """Print how many mutants each package had, and how many were killed."""
    rows: dict[str, list[bool]] = defaultdict(list)
    for line in (folder / "outcomes.jsonl").read_text().splitlines():
        mutant = json.loads(line)
        top, *inner = Path(mutant["path"]).parts[:-1]
        for name in {"/".join([top, *inner[:1]]), "all"}:
            rows[name].append(mutant["outcome"] == "killed")
    for name, killed in sorted(rows.items()):
        print(f"{name:28} {sum(killed):4} of {len(killed):4}  {sum(killed) / len(killed):5.0%}")


def main() -> None:
    """Run one of the tasks."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("task", choices=["cover", "run", "table"])
    parser.add_argument("tests", nargs="*", default=["tests"], help="tests that are run (cover)")
    parser.add_argument("--count", type=int, default=300, help="mutants")
    parser.add_argument("--seed", type=int, default=0, help="seed of the sample")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds of tests tried on one mutant")
    parser.add_argument("--folder", type=Path, default=ROOT / ".mutants", help="where results lie")
    given = parser.parse_args()
    given.folder.mkdir(parents=True, exist_ok=True)
    if given.task == "cover":
        cover(given.folder, given.tests)
    elif given.task == "run":
        run(given.folder, given.count, given.seed, given.limit)
    else:
        table(given.folder)


if __name__ == "__main__":
    main()
