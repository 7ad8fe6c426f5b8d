"""A file of finished pieces of work, one line each: an interrupted run goes on where it stopped."""

import json
import os
import zlib
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import ghgs_lit
from ghgs_lit.readers import read_lines_of_json

Rows = list[dict[str, Any]]


@cache
def code_digest() -> str:
    """Of the sources of the package: rows of other code are not taken over."""
    digest = 0
    for path in sorted(Path(ghgs_lit.__file__).parent.rglob("*.py")):
        digest = zlib.crc32(path.read_bytes(), digest)
    return f"{digest:08x}"


class Journal:
    """Rows of finished pieces by key; those that an earlier run with the same code wrote are there."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._done = dict(self._read())

    def __contains__(self, key: str) -> bool:
        return key in self._done

    def __getitem__(self, key: str) -> Rows:
        return self._done[key]

    def add(self, key: str, rows: Rows) -> None:
        """Note a finished piece; its line is on its way to the disk when this returns."""
        line = json.dumps({"key": key, "code": code_digest(), "rows": rows})
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("ab") as file:
            if file.tell() and not self._ends_whole():
                line = "\n" + line
            file.write(line.encode() + b"\n")
        self._done[key] = rows

    def say_done(self, keys: Sequence[str], what: str) -> None:
        """Print how many of ``keys`` are there already, if any are."""
        if count := sum(key in self for key in keys):
            print(f"{self.path}: {count} of {len(keys)} {what} are done already", flush=True)

    def _ends_whole(self) -> bool:
        """False where a process was killed while it wrote the last line."""
        with self.path.open("rb") as file:
            file.seek(-1, os.SEEK_END)
            return file.read() == b"\n"

    def _read(self) -> Iterator[tuple[str, Rows]]:
        """Lines of other code, and a last line that was cut off, are left out."""
        for entry in read_lines_of_json(self.path) if self.path.exists() else ():
            if entry.get("code") == code_digest():
                yield entry["key"], entry["rows"]
