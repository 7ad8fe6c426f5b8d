"""Readers of text files, with limits of size and depth, and of arrays; every defect is an
:class:`InputError`."""

import csv
import functools
import io
import json
import os
import stat
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from ghgs_lit.errors import InputError, require

if TYPE_CHECKING:  # NumPy is imported on first use, for the start time of commands
    import numpy as np

#: Largest size of a text file in bytes, and largest depth of nested mappings and lists.
LARGEST = 1 << 28
DEEPEST = 64
_NO_TEXT = (yaml.YAMLError, csv.Error)


def require_file(path: str | os.PathLike, expected: str) -> None:
    """Reject a path that is not a regular file: missing, a folder, a link to itself, a pipe.

    Args:
        path: the path; a link to a regular file is valid.
        expected: expected content, in words.

    Raises:
        InputError: names the path and what was found there.
    """
    try:
        is_file = stat.S_ISREG(os.stat(path).st_mode)
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        raise InputError(
            f"{path}: expected {expected}; found {'no such file' if missing else error.strerror}"
        ) from error
    require(is_file, str(path), expected, "a folder" if os.path.isdir(path) else "no regular file")


def require_folder(folder: Path, expected: str = "the folder of the data set") -> None:
    """Reject a folder that is missing.

    Args:
        folder: its path.
        expected: the expected folder, in words.

    Raises:
        InputError: names the path.
    """
    if not folder.is_dir():
        found = "a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: expected {expected}; found {found}")


def normalize_name(name: str) -> str:
    """Normalise a name to composed characters (NFC); macOS stores an umlaut as two characters."""
    return unicodedata.normalize("NFC", name)


def split_path(name: str) -> list[str]:
    """Split a path with slashes or backslashes into NFC-normalised folders and file."""
    return normalize_name(name).replace("\\", "/").split("/")


def find_path(folder: Path, name: str, suffixes: Sequence[str] = ("",)) -> Path | None:
    """Find the file or folder ``name``, also if another program or system spelled it.

    A path that exists exactly as written takes precedence. Otherwise the name may contain backslashes
    and characters that are not NFC-normalised, and may differ by case if only one entry matches.

    Args:
        folder: base of relative names.
        name: a name or path, without the suffix where ``suffixes`` are given.
        suffixes: endings, the preferred first.

    Returns:
        An existing path; None: no match.
    """
    for suffix in suffixes:
        try:
            if (exact := folder / f"{name}{suffix}").exists():
                return exact
        except (OSError, ValueError):  # too long, a null character, links in a loop
            continue
    *folders, last = split_path(name)
    for part in folders:
        below = folder / part if part in ("", ".", "..") else _find_entry(folder, part)
        if below is None:
            return None
        folder = below
    return next((path for suffix in suffixes if (path := _find_entry(folder, f"{last}{suffix}"))), None)


def _find_entry(folder: Path, name: str) -> Path | None:
    """The only entry of a folder that is spelled as ``name``, or else differs only by case."""
    if not folder.is_dir():
        return None
    paths = _list_folder(folder, folder.stat().st_mtime_ns).get(name.casefold(), [])
    stem = Path(name).stem
    same = [path for path in paths if normalize_name(path.stem) == stem] or paths
    return same[0] if len(same) == 1 else None


@functools.lru_cache(maxsize=64)
def _list_folder(folder: Path, changed: int) -> dict[str, list[Path]]:
    """Entries of a folder by their composed names in lower case.

    ``changed``, the folder's time of modification in nanoseconds, invalidates the cache.
    """
    paths: dict[str, list[Path]] = {}
    for path in sorted(folder.iterdir()):
        paths.setdefault(normalize_name(path.name).casefold(), []).append(path)
    return paths


def read_text(path: Path, expected: str = "text") -> str:
    """Read a UTF-8 file, without its byte order mark.

    Args:
        path: the file.
        expected: expected content, in words.

    Raises:
        InputError: no file, over 256 MB, or not UTF-8.
    """
    require_file(path, expected)
    try:
        size = path.stat().st_size
        require(size <= LARGEST, str(path), f"{expected} of at most {LARGEST >> 20} MB", f"{size >> 20} MB")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: expected {expected}; found {error}") from error


def read_json(path: Path, expected: str = "JSON") -> Any:
    """Read a JSON file.

    Args:
        path: the file.
        expected: expected content, in words.

    Raises:
        InputError: as for :func:`read_text`; not JSON; more than :data:`DEEPEST` levels.
    """
    return read_parsed(path, expected, json.loads)


def read_yaml(path: Path) -> Any:
    """Read a YAML file of plain data.

    Raises:
        InputError: as for :func:`read_json`, or an alias, by which content can grow without limit.
    """
    return read_parsed(path, "YAML", _parse_plain_yaml)


def read_rows(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file as dicts keyed by its header.

    Raises:
        InputError: as for :func:`read_text`, or not CSV.
    """
    return read_parsed(
        path, "CSV with a header", lambda text: list(csv.DictReader(io.StringIO(text, newline="")))
    )


def read_npy(path: Path, expected: str = "a readable .npy file") -> "np.ndarray":
    """Read an ``.npy`` file without Python objects.

    Args:
        path: the file.
        expected: expected content, in words.

    Raises:
        InputError: missing, another format, or truncated.
    """
    import numpy as np  # commands without arrays start sooner

    require_file(path, expected)
    try:
        # Mapping a truncated file fails at once; reading it would first allocate the memory.
        return np.array(np.load(path, allow_pickle=False, mmap_mode="r"))
    except Exception as error:  # headers are Python literals, whose tokenizer raises further errors
        raise InputError(f"{path}: expected {expected}; found a file that cannot be read: {error}") from error


def _parse_plain_yaml(text: str) -> Any:
    check_yaml(text, aliases=False)
    content = yaml.safe_load(text)
    json.dumps(content)  # rejects other types, such as dates, sets and bytes
    return content


def check_yaml(text: str, aliases: bool = True, most: int = 1_000_000) -> None:
    """Reject YAML that is unsafe to load.

    Args:
        text: the YAML.
        aliases: whether aliases (``*name``) are allowed.
        most: largest number of values; each use of an alias counts the values of its anchor.

    Raises:
        ValueError: more than :data:`DEEPEST` levels or ``most`` values, or a forbidden alias.
        yaml.YAMLError: not YAML.
    """
    sizes: dict[str | None, int] = {}
    unfinished: list[list[Any]] = [[None, 0]]
    for event in yaml.parse(text, yaml.SafeLoader):
        match event:
            case yaml.CollectionStartEvent():
                unfinished.append([event.anchor, 1])
                if len(unfinished) > DEEPEST + 1:
                    raise ValueError(f"more than {DEEPEST} levels")
                continue
            case yaml.CollectionEndEvent():
                anchor, size = unfinished.pop()
            case yaml.ScalarEvent():
                anchor = event.anchor
                size = 1
            case yaml.AliasEvent():
                if not aliases or event.anchor not in sizes:
                    raise ValueError("an alias (*name)")
                anchor = event.anchor
                size = sizes[event.anchor]
            case _:
                continue
        sizes[anchor] = size
        unfinished[-1][1] += size
        if unfinished[-1][1] > most:
            raise ValueError(f"more than {most} values")


def read_parsed(path: Path, expected: str, parse: Callable[[str], Any]) -> Any:
    """Read a file and parse its text.

    Args:
        path: the file.
        expected: expected content, in words.
        parse: converts the text to plain data.

    Raises:
        InputError: as for :func:`read_text`; ``parse`` fails; more than :data:`DEEPEST` levels.
    """
    try:
        value = parse(read_text(path, expected))
        if _count_levels(value) > DEEPEST:
            raise ValueError(f"more than {DEEPEST} levels")
    except InputError:
        raise
    except (LookupError, ValueError, TypeError, ArithmeticError, RecursionError, *_NO_TEXT) as error:
        mark = getattr(error, "problem_mark", None)
        found = error
        if mark is not None:
            problem = str(error.problem).removeprefix("found ")
            found = f"{problem} in line {mark.line + 1}, column {mark.column + 1}"
        raise InputError(f"{path}: expected {expected}; found {found}") from error
    return value


def _count_levels(value: Any) -> int:
    """Number of levels of nested mappings and lists.

    Raises:
        ValueError: an integer that does not fit in a float.
    """
    if isinstance(value, int) and value.bit_length() > 1023:
        raise ValueError(f"a number of {value.bit_length()} bits")
    children = value.values() if isinstance(value, dict) else value
    return 1 + max(map(_count_levels, children), default=0) if isinstance(value, dict | list) else 0
