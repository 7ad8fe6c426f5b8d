"""Cached machine code is loaded only if it is intact and built from the same sources."""

import ast
import importlib.util
import sys
from pathlib import Path

import numba
import pytest
from numba.core import event

import ghgs_lit
from ghgs_lit.ops import compile
from ghgs_lit.ops.compile import FirstCompilation

PACKAGE = Path(ghgs_lit.__file__).parent
#: Folders of kernels and the constants that they use.
FOLDERS = sorted({path.parent for path in PACKAGE.glob("ops/*/*.py") if "ops.compile" in path.read_text()})


@pytest.fixture
def hits(tmp_path, monkeypatch):
    """A function that reloads a module, runs its kernel and returns the number of cache hits."""
    source = tmp_path / "scaled.py"
    source.write_text(
        "from ghgs_lit.ops import compile\n\n\n@compile.kernel\ndef double(x):\n    return x + x\n"
    )

    def run(digest="a"):
        monkeypatch.setattr(compile, "_digest", lambda folder: digest)
        spec = importlib.util.spec_from_file_location("scaled", source)
        module = importlib.util.module_from_spec(spec)
        sys.modules["scaled"] = module
        spec.loader.exec_module(module)
        assert module.double(2) == 4
        return sum(module.double.stats.cache_hits.values())

    yield run
    sys.modules.pop("scaled", None)


def test_machine_code_of_other_sources_is_not_taken_from_the_cache(hits):
    """Machine code built from other sources is never loaded; code of the same sources is."""
    assert [hits("a"), hits("a"), hits("b"), hits("b")] == [0, 1, 0, 1]


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("damage", ["truncated", "empty", "foreign", "a folder"])
def test_a_damaged_file_of_the_cache_is_made_anew(hits, tmp_path, suffix, damage):
    hits()
    (file,) = tmp_path.rglob(f"*.{suffix}")
    content = file.read_bytes()
    if damage == "a folder":
        file.unlink()
        file.mkdir()
    else:
        cut = {"truncated": len(content) // 2, "empty": 0, "foreign": 0}[damage]
        file.write_bytes(content[:cut] + b"{}" * (damage == "foreign"))
    first, second = hits(), hits()
    assert (first, second) == ((0, 0) if damage == "a folder" else (0, 1))


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda path: path.name)
def test_the_key_covers_all_that_kernels_read(folder, monkeypatch):
    """A changed file of the folder changes the key, and constants are imported from no other folder."""
    files = sorted({*folder.glob("*.py"), *(PACKAGE / "ops").glob("*.py")})
    modules = {".".join(("ghgs_lit", *file.relative_to(PACKAGE).with_suffix("").parts)) for file in files}
    names = {name for module in modules for name in (module, module.rpartition(".")[0])}
    for file in folder.glob("*.py"):
        if "ops.compile" in (text := file.read_text()):
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.ImportFrom) and any(alias.name.isupper() for alias in node.names):
                    assert node.module in names, file
    compile._digest.cache_clear()
    before, read = compile._digest(folder), Path.read_bytes
    for file in files:  # such as activation/__init__.py, whose SAME is compiled into machine code
        changed = lambda path, file=file: read(path) + b"#" * (path == file)  # noqa: E731
        monkeypatch.setattr(Path, "read_bytes", changed)
        compile._digest.cache_clear()
        assert compile._digest(folder) != before, file
    compile._digest.cache_clear()


def test_the_first_compilation_says_so(capsys, monkeypatch):
    """A first prediction that compiles for a minute must not appear to hang; workers print nothing."""
    numba.njit(lambda x: x)(1)  # makes the listener of this process print
    capsys.readouterr()
    with event.install_listener("numba:compile", FirstCompilation()):
        for number in range(2):
            numba.njit(lambda x, y=number: x + y)(1)
    assert capsys.readouterr().err.count("compiling kernels for this processor") == 1
    monkeypatch.setattr(FirstCompilation, "is_said", True)  # as in worker processes
    with event.install_listener("numba:compile", FirstCompilation()):
        numba.njit(lambda x: x - 1)(1)
    assert "compiling" not in capsys.readouterr().err
