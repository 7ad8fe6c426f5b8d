"""Run every command of the documentation as printed, document by document, in the order of the text.

    python scripts/check_documents.py                          # everything that can run here
    python scripts/check_documents.py README.md docs/data.md   # some documents
    python scripts/check_documents.py --fast                   # fast commands and their prerequisites

Commands are the lines of ``bash`` blocks, whole ``python`` blocks, and commands in running text. Each
document gets an empty folder with links to parts of the checkout. Three tables in
``document_commands.py`` list where runs differ from the text: NOT_RUN (excluded, with the reason),
SMALL (small settings, and stand-ins for the reader's files) and BEFORE (files that a document
expects). One line is printed for each command; the exit code is 1 if one fails.

A comment above a table of figures, in its section, states their origin (`none`: not applicable):

    <!-- figures: ghgs evaluate checkpoint=shipped; commit 96ee19c1; weights ce8df77b3fbf; people 2 -->

The commit is the one that measured them, or that added them to the documents; weights are the first
digits of their digest, people the version of the frozen ones. If one is not the current one, the
section must mention "older weights" or "older people", and be in docs/evidence.
"""

import argparse
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from ghgs_lit.weights.frozen import digest_of
from ghgs_lit.weights.reading import SHIPPED_FILE
from ghgs_people.bench import definition

sys.path.insert(0, str(Path(__file__).parents[1]))
from scripts.document_commands import BEFORE, FAST, GIVEN, NOT_RUN, SMALL

ROOT = Path(__file__).resolve().parents[1]
LIMIT = 600  # seconds for one command

#: Current weights and people, as in the comments above figures.
TODAY = {
    "weights": digest_of(torch.load(SHIPPED_FILE, weights_only=True)["state_dict"])[:12],
    "people": str(definition("sealed")["version"]),
}
STAMP = r"<!-- figures: .+; commit (?P<commit>\w+); weights (?P<weights>\w+); people (?P<people>\w+) -->\n"
#: Commits, one a line; empty if the history is incomplete.
HISTORY = subprocess.run("git rev-list HEAD", shell=True, cwd=ROOT, capture_output=True, text=True).stdout
HISTORY *= (ROOT / ".git").exists() and not (ROOT / ".git" / "shallow").exists()
LEAST = 4  #: a table with as many decimal cells is a table of figures


@dataclass(frozen=True)
class Command:
    """A command of a document; ``text`` is as printed, without continuation lines and comments."""

    document: str
    line: int
    text: str
    is_python: bool = False

    @property
    def title(self) -> str:
        return f"python, {self.text.count(chr(10)) + 1} lines" if self.is_python else self.text

    @property
    def key(self) -> str:
        """Text that the patterns of the tables are matched against."""
        return "#python" if self.is_python else self.text

    @property
    def reason(self) -> str | None:
        """Reason for not running it; None: it is run."""
        return next((why for pattern, why in NOT_RUN if re.match(pattern, self.key)), None)

    @property
    def is_fast(self) -> bool:
        return self.document in FAST and re.match(FAST[self.document], self.key) is not None

    def script(self) -> tuple[str, list[str]]:
        """The script to run, and the reasons for its differences from the text."""
        given = GIVEN.get(self.document, "") if self.is_python else ""
        text, reasons = given + self.text, []
        for pattern, instead, why in SMALL:
            changed = re.sub(pattern, instead, text)
            if changed != text:
                text, reasons = changed, [*reasons, why]
        return text, reasons


def documents() -> list[str]:
    """All documents, relative to the repository."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [path.relative_to(ROOT).as_posix() for path in found]


def commands(document: str) -> list[Command]:
    """The commands of a document in the order of the text, without repetitions."""
    text = (ROOT / document).read_text()
    found = [*_find_in_blocks(document, text), *_find_in_prose(document, text)]
    first: dict[str, Command] = {}
    for command in sorted(found, key=lambda c: c.line):
        first.setdefault(command.text, command)
    return list(first.values())


def _find_in_blocks(document: str, text: str) -> Iterator[Command]:
    for block in re.finditer(r"^```(bash|python)\n(.*?)^```", text, re.M | re.S):
        first = text.count("\n", 0, block.start()) + 2
        if block[1] == "python":
            yield Command(document, first, block[2], is_python=True)
            continue
        joined, start = "", first
        for number, line in enumerate(block[2].splitlines(), first):
            joined, start = (joined + line.strip(), start) if joined else (line.strip(), number)
            if joined.endswith("\\"):
                joined = joined[:-1]
                continue
            command = re.sub(r"(^|\s+)#\s.*", "", joined)
            joined = ""
            if command:
                yield Command(document, start, command)


def _find_in_prose(document: str, text: str) -> Iterator[Command]:
    """Code spans that begin like a command and have an argument."""
    prose = _remove_blocks(text)
    program = r"(?:ghgs --help|ghgs\s\w+\s\S*(?:=|--help)|python \w+/|make \w|pip install|tensorboard )"
    for span in re.finditer(rf"(?<!`)`((?:\w+=\S+ )?{program}[^`]*)`(?!`)", prose):
        yield Command(document, prose.count("\n", 0, span.start()) + 1, " ".join(span[1].split()))


def _remove_blocks(text: str) -> str:
    return re.sub(r"^```.*?^```", lambda block: "\n" * block[0].count("\n"), text, flags=re.M | re.S)


def stale_figures(document: str) -> list[str]:
    """Find tables of figures without origin or with outdated weights or people, and unknown commits.

    Args:
        document: relative to the repository.

    Returns:
        A line for each fault.
    """
    text = _remove_blocks((ROOT / document).read_text())
    named = re.findall(r"\b(?!a\d{7})(?=\d*[a-f])(?=[a-f]*\d)[0-9a-f]{7,8}\b", text)
    missing = [c for c in named if HISTORY and not re.search(f"^{c}", HISTORY, re.M)]
    faults = [f"{commit}: expected a commit of this repository" for commit in missing]
    for section in re.split(r"^(?=#)", text, flags=re.M):
        stamp = None
        for part in re.finditer(rf"^{STAMP}|^(?:\|.*\n)+", section, re.M):
            if part["commit"]:
                stamp = part
            elif len(re.findall(r"\| [*+-]*\d+\.\d", part[0])) >= LEAST:
                title = part[0].splitlines()[0]
                faults += [f"{title}: {fault}" for fault in _faults_of(stamp, section, document)]
    return [f"{document}: {fault}" for fault in faults]


def _faults_of(stamp: re.Match | None, section: str, document: str) -> list[str]:
    if stamp is None:
        return ["expected `<!-- figures: ... -->` above it"]
    old = [kind for kind, today in TODAY.items() if stamp[kind] not in (today, "none")]
    labelled = [k for k in old if f"older {k}" in section.lower() and document.startswith("docs/evidence/")]
    return [f"{kind}: expected {TODAY[kind]}; found {stamp[kind]}" for kind in old if kind not in labelled]


class Reader:
    """Run the commands of one document in a separate folder, as its reader would."""

    def __init__(self, folder: Path, document: str) -> None:
        self.folder = folder / document.replace("/", "_").removesuffix(".md")
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        for name in ("benchmarks", "docs", "examples", "scripts"):
            (self.folder / name).symlink_to(ROOT / name)
        programs = folder / "bin"
        programs.mkdir(exist_ok=True)
        for name, arguments in {"python": "", "ghgs": "-m ghgs_lit"}.items():
            (programs / name).write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments} "$@"\n')
            (programs / name).chmod(0o755)
        path = os.pathsep.join([str(programs), str(Path(sys.executable).parent), os.environ["PATH"]])
        python_path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        self.environment = {**os.environ, "PATH": path, "PYTHONPATH": python_path}
        self.environment.setdefault("GHGS_CACHE", str(folder / "cache"))
        self.exported: list[str] = []

    def run(self, text: str, is_python: bool = False) -> tuple[int, float, str]:
        """Run a command; return exit code, seconds and output."""
        script = "\n".join(["set -e", *self.exported, text])
        argv = [sys.executable, "-c", text] if is_python else ["bash", "-c", script]
        start = time.monotonic()
        process = subprocess.Popen(
            argv, cwd=self.folder, env=self.environment, stdin=subprocess.DEVNULL, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            output, _ = process.communicate(timeout=LIMIT)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            output = f"{process.communicate()[0]}\nstopped after {LIMIT} s"
        self.exported += re.findall(r"\bexport \w+=\S+", text) if process.returncode == 0 else []
        return process.returncode, time.monotonic() - start, output


def check(document: str, folder: Path, fast: bool = False) -> Counter:
    """Run the commands of one document and print a line for each.

    Args:
        document: relative to the repository.
        folder: parent of the document's folder.
        fast: only commands that end within seconds.

    Returns:
        Numbers of commands that ran, failed, and were not run.
    """
    count: Counter = Counter()
    chosen = [c for c in commands(document) if not fast or (c.is_fast and c.reason is None)]
    reader = Reader(folder, document)
    needs_files = [c for c in chosen if c.reason is None and not re.search(r"--help|dry_run=true", c.text)]
    if needs_files:
        for text in BEFORE.get(document, ()):
            _run_one(reader, f"{document} (before)", text.splitlines()[0], text, False, [], count)
    for command in chosen:
        place = f"{document}:{command.line}"
        script, reasons = command.script()
        if command.reason is not None:
            count["not run"] += 1
            print(f"not run            {place}  {command.title}  ({command.reason})", flush=True)
        else:
            _run_one(reader, place, command.title, script, command.is_python, reasons, count)
    return count


def _run_one(
    reader: Reader, place: str, title: str, script: str, is_python: bool, reasons: list[str], count: Counter
) -> None:
    code, seconds, output = reader.run(script, is_python)
    count["failed" if code else "ran"] += 1
    print(
        f"{'ran' if code == 0 else 'FAILED':<7}{seconds:5.0f} s {code:>4}  {place}  {title}{_join(reasons)}",
        flush=True,
    )
    if code:
        print(f"    as run: {script}\n    " + "\n    ".join(output.strip().splitlines()[-15:]), flush=True)


def _join(reasons: Sequence[str]) -> str:
    return f"  ({'; '.join(dict.fromkeys(reasons))})" if reasons else ""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("documents", nargs="*", help="relative to the repository; none: all")
    parser.add_argument(
        "--fast", action="store_true", help="only what ends within seconds, and what that needs"
    )
    parser.add_argument("--folder", type=Path, help="where commands are run; none: a temporary folder")
    given = parser.parse_args(arguments)
    unknown = sorted(set(given.documents) - set(documents()))
    if unknown:
        parser.error(f"expected documents of {', '.join(documents())}; found {unknown[0]}")
    faults = [fault for document in given.documents or documents() for fault in stale_figures(document)]
    print(*faults, sep="\n", end="\n" if faults else "")
    total: Counter = Counter(failed=len(faults))
    with tempfile.TemporaryDirectory(prefix="documents") as temporary:
        folder = (given.folder or Path(temporary)).resolve()
        for document in given.documents or documents():
            total += check(document, folder, given.fast)
    print(", ".join(f"{total[kind]} {kind}" for kind in ("ran", "failed", "not run")))
    return 1 if total["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
