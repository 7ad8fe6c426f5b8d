"""Plant defects in functions by replacing one expression with another."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
#: Names that match any expression in a change.
ANY = ("A", "B", "C", "D")
CODE = "ghgs_*/**/*.py"


def definitions(body: list[ast.stmt], prefix: str = "") -> Iterator[tuple[str, ast.stmt]]:
    """Names and nodes of functions, classes, methods and constants in the body of a module or class."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield prefix + node.name, node
        if isinstance(node, ast.ClassDef):
            yield from definitions(node.body, f"{prefix}{node.name}.")
        if isinstance(node, ast.Assign | ast.AnnAssign):
            yield prefix + ast.unparse(getattr(node, "target", None) or node.targets[0]), node


@cache
def _names(files: str) -> dict[str, tuple[str, str]]:
    """File, and name inside it, of each dotted name; the latter is empty for a module."""
    names = {}
    for path in ROOT.glob(files):
        file = path.relative_to(ROOT)
        module = ".".join(file.with_suffix("").parts).removesuffix(".__init__")
        names[module] = str(file), ""
        for name, _ in definitions(ast.parse(path.read_text()).body):
            names[f"{module}.{name}"] = str(file), name
    return names


def found(files: str, end: str) -> tuple[str, str]:
    """File, and name inside it, of the only definition whose dotted name ends with ``end``.

    Raises:
        ValueError: no definition matches, or several do.
    """
    fitting = [name for name in _names(files) if f".{name}".endswith(f".{end}")]
    if len(fitting) != 1:
        raise ValueError(f"{end}: expected the end of one name in {files}; found {fitting or 'none'}")
    return _names(files)[fitting[0]]


def _fits(pattern: object, node: object, bound: dict[str, ast.expr]) -> bool:
    """Whether code matches a pattern; stores the expressions for ``ANY`` in ``bound``."""
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
    """Replace code that matches the left side of ``before → after``, and count the replacements."""

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
        ValueError: the left side does not match exactly once, or the code would stay equal.
    """
    transformer, before = _Change(change), ast.dump(code)
    transformer.visit(code)
    if transformer.count != 1 or ast.dump(code) == before:
        raise ValueError(f"{change}: expected once, and a change; found {transformer.count} times")
