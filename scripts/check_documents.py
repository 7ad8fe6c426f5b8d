"""Run every command of the documentation as it is printed, document by document, in the order of the text.

    python scripts/check_documents.py                          # everything that can run here
    python scripts/check_documents.py README.md docs/data.md   # some documents
    python scripts/check_documents.py --fast                   # what ends within seconds, and what that needs
    python scripts/check_documents.py --list                   # what would be run, and what not and why

Commands are the lines of ``bash`` blocks, ``python`` blocks as a whole, and commands in running text. Each
document gets an empty folder with links to what a checkout has. Three tables list where runs differ from the
text: NOT_RUN (left out, with the reason), SMALL (small settings, and stand-ins for files of the reader) and
BEFORE (what a document expects to be there). One line is printed for each command; the exit code is 1 if one
fails.

Above a table of figures, in its section, stands what they are of (`none`: they depend on no such thing):

    <!-- figures: ghgs evaluate checkpoint=shipped; commit 96ee19c1; weights ce8df77b3fbf; people 2 -->

The commit is the one that measured them, or at which they entered the documents; weights are the first
digits of their digest, people the version of the frozen ones. Where one is not today's, the section must
call them "older weights" or "older people", and lie in docs/evidence.
"""

import argparse
import importlib.util
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

ROOT = Path(__file__).resolve().parents[1]
LIMIT = 600  # seconds for one command

#: What figures of today are of.
TODAY = {
    "weights": digest_of(torch.load(SHIPPED_FILE, weights_only=True)["state_dict"])[:12],
    "people": str(definition("sealed")["version"]),
}
STAMP = r"<!-- figures: .+; commit (?P<commit>\w+); weights (?P<weights>\w+); people (?P<people>\w+) -->\n"
#: Commits, one a line; empty where the history is not whole.
HISTORY = subprocess.run("git rev-list HEAD", shell=True, cwd=ROOT, capture_output=True, text=True).stdout
HISTORY *= (ROOT / ".git").exists() and not (ROOT / ".git" / "shallow").exists()
LEAST = 4  #: cells that begin with a decimal: the least of a table of figures

PUBLISHED = "needs published weights"
NETWORK = "needs a package index"
# A pattern at the beginning of a command, and why such a command is not run.
NOT_RUN = [
    (r"make (?!demo$|bench$)", "sets up an environment, or is what continuous integration runs"),
    (r"\w+=\S+ make demo", NETWORK),
    (r"pip install", NETWORK),
    (r"git clone|python3 -m venv", "makes a checkout and its environment"),
    (r"source ", "the commands run in the environment of this script"),
    (r"ghgs import", PUBLISHED),
    (r"ghgs \w+ checkpoint=release\.ckpt", PUBLISHED),
    (r"ghgs train (?!.*dry_run).*encoder=vggt_1b", PUBLISHED),
    (r"ghgs train .*hydra/launcher=slurm", "needs a cluster"),
    (r"bash scripts/slurm_drill", "needs SLURM"),
    (r"ghgs (train|evaluate|benchmark) .*split=bench", "renders forty people"),
    (r"ghgs table .*runs/ablation", "needs twelve runs"),
    (r"(GHGS_PLUGINS=\S+ )?ghgs (train|table) .*controls", "needs 21 runs"),
    (r"ghgs (train|table) .*runs/peers|ghgs evaluate .*train: 48", "needs 60 people, or runs of theirs"),
    (r"ghgs (train|export) .*runs/shipped", "renders 344 people"),
    (r"python scripts/mutate\.py", "runs the whole suite"),
    (r"python -m pytest -m gpu|python benchmarks/gpu\.py (?!.*--dry)", "needs a GPU and a checkout"),
    (r"ghgs evaluate .*per_scene", "fits Gaussians to each person, for minutes"),
    (r"ghgs stress$", "takes a quarter of an hour"),
    (r"python scripts/drill\.py", "trains twelve runs, killed ten times"),
    (r"SMPL_MODEL=…", "needs the licensed body model and both data sets"),
]
if importlib.util.find_spec("smplx") is None:
    NOT_RUN.append((r"ghgs .*data\.smpl_model=|SMPL_MODEL=/", "needs the package smplx"))

CPU = "encoder=vggt_nano optimizer=from_scratch trainer=cpu"
TINY = "data.people='{train: 2, val: 2}' data.size=56 data.render.samples=1 data.render_workers=0"
SHORT = "trainer.max_steps=2 trainer.val_check_interval=2 trainer.limit_val_batches=1"
FEW = "--size 128 --train 2 --val 1"
TRAIN = r"^(ghgs train (?!.*(?:dry_run|-help))"  # begins the pattern of a command that trains
# A pattern, what is put in its place, and why.
SMALL = [
    (r"^make demo$", f"bash scripts/demo.sh {TINY} {SHORT}", "without the set-up, two steps"),
    (r"^bash scripts/demo\.sh$", f"bash scripts/demo.sh {TINY} {SHORT}", "two steps"),
    (r"\btrainer=gpu\b", "trainer=cpu", "no GPU"),
    (r"^make bench$", "python benchmarks/rasterizer.py", "without the set-up"),
    (r"^(ghgs benchmark (?!.*-help).*)", r"\1 timing.repeats=1 subjects=1", "one round"),
    (r"^(ghgs benchmark data=synthetic .*)", rf"\1 {TINY}", "two people of 56 x 56 pixels"),
    (r"refine=15", "refine=2", "two steps"),
    (r"^(ghgs predict .*)", r"\1 turntable.frames=2", "two pictures"),
    (r"images=videos (.*)masks=mask_videos", r"images=instants \1masks=instant_masks", "two instants"),
    (r"minutes=3", "minutes=1", "a minute"),
    (r"^(ghgs predict data=.*)", r"\1 data.size=112", "112 x 112 pixels"),
    (r"(?<==)/data/", "", "folders next to this one"),
    (r"data\.active\.train=\d+", "data.active.train=1", "one person"),
    (r"^(ghgs pretext .*)", rf"\1 {TINY} {SHORT}", "two people of 56 x 56 pixels, two steps"),
    (r"^(tensorboard .*)", r"timeout 20 \1 --port 0 || [ $? = 124 ]", "a server: stopped after 20 s"),
    (r" init_from=(?:start|vggt)\.ckpt", "", PUBLISHED),
    (r"^(ghgs view .*)", r"\1 seconds=1", "a server: stopped after 1 s"),
    (r"runs/train/<time>", "runs/train/$(ls runs/train | grep ^20 | tail -n 1)", "the last run"),
    (r"<run>", "runs/before", "a small run"),
    (r"<checkpoint>", "shipped", "the weights that come with the package"),
    (r"(?<=runs=runs/train/)(<sweep>|mine)", "paper", "a small sweep"),
    (r"(?<=data\.root=)\.\.\.", "zju", "a miniature"),
    (r"(?<=THuman2\.0_Release )data\.root=rendered", "data.root=rendered_scans", "next to the miniature"),
    (r"their_results\.json", "docs/example_others.json", "a complete file"),
    (r"data\.render\.size=\d+", "data.render.size=56 data.render.samples=1 data.render_workers=0",
     "small photographs"),
    (r"^(ghgs prepare task=render(?!.*render\.size).*)", r"\1 data.render.size=56", "small photographs"),
    (r"^(.*miniature\.py.*)", rf"\1 {FEW}", "few people"),
    (r"^(python benchmarks/captures\.py.*)", r"\1 --people 1", "one person"),
    (r"^(ghgs train (?!.*dry_run).*sweep=table\d.*)", r"\1 dry_run=true", "needs a GPU: planned only"),
    (r"^(ghgs train .*sweep=table\d.*dry_run=true.*)", r"\1 || [ $? = 1 ]", "reports what it lacks here"),
    (r"(?<=seed=1,2),3(,4)?", "", "two seeds"),
    (TRAIN + r".*(?:experiment=(?:demo|shipped)|data=synthetic).*)", rf"\1 {TINY}",
     "two people of 56 x 56 pixels"),
    (TRAIN + r".*experiment=shipped.*)", r"\1 data.active.train=1 augmentation=none trainer=cpu", "small"),
    (TRAIN + r".*data.root=rendered.*)", r"\1 data.size=56", "56 x 56 pixels"),
    (TRAIN + r"(?!.*vggt_nano).*experiment=(?:thuman2|zju_mocap|humman).*)", rf"\1 {CPU}", "no GPU"),
    (TRAIN + r".*experiment=zju_mocap.*)", r"\1 data.size=112", "112 x 112 pixels"),
    (TRAIN + r".*)", rf"\1 {SHORT}", "two steps"),
]  # fmt: skip

_SCANS = "python scripts/miniature.py data=thuman2 data.source={} --size 64 --train 2"
_RENDER = "ghgs prepare task=render data=scans data.source={} data.root=rendered data.render.size=60"
_RENDERED = (_SCANS.format("scans"), _RENDER.format("scans"))
_RUN = f"ghgs train experiment=demo {TINY} {SHORT}"
_SWEEP = (
    f"ghgs train -m experiment=demo {TINY} {SHORT} ablation=full,neither 'evaluation.views=[4]' "
    "evaluation.pictures=0 logger=none callbacks=none hydra.sweep.dir=runs/train/paper"
)
_ABLATION = (
    "mkdir -p my_conf/ablation && "
    r"printf '# @package _global_\nrecalibration: {k: 1}\n' > my_conf/ablation/one_neighbor.yaml"
)
_CHECKPOINTS = (
    f"{_RUN} hydra.run.dir=runs/mine",
    *(f"cp runs/mine/checkpoints/last.ckpt {n}.ckpt" for n in "ab"),
)
# Photographs of static cameras in the layout of docs/template, from rendered scans.
_PHOTOGRAPHS = """python - <<'END'
from pathlib import Path
import numpy as np
from PIL import Image
for phase in ("train", "val"):
    root = Path("rendered", phase)
    for person in sorted(p.name[:-4] for p in (root / "img").glob("*_000")):
        folder = Path("photographs", phase, person)
        folder.mkdir(parents=True)
        names = [f"{person}_{position:03d}" for position in range(0, 16, 2)]
        for camera, name in enumerate(names):
            image = Image.open(root / "img" / name / "0.jpg")
            mask = Image.open(root / "mask" / name / "0.png").convert("L")
            image.putalpha(mask.point(lambda value: 255 * (value > 0)))
            image.save(folder / f"{camera}.png")
        cameras = {kind: [np.load(root / "parm" / name / f"0_{kind[:-1]}.npy") for name in names]
                   for kind in ("intrinsics", "extrinsics")}
        np.savez(folder / "cameras.npz", **cameras)
        np.save(folder / "body.npy", np.random.default_rng(0).normal(size=(99, 3)) * 0.2)
END"""
# The same as the photographs of a user: a folder of photographs, one of masks, and a calibration.
_CAPTURE = """python - <<'END'
import json, shutil
from pathlib import Path
import numpy as np
root, cameras = Path("rendered/val"), {}
names = sorted(p.name for p in (root / "img").iterdir())[:16:4]
for folder in ("photographs", "masks"):
    Path(folder).mkdir()
for name in names:
    shutil.copy(root / "img" / name / "0.jpg", f"photographs/{name}.jpg")
    shutil.copy(root / "mask" / name / "0.png", f"masks/{name}.png")
    cameras[name] = {kind + "s": np.load(root / "parm" / name / f"0_{kind}.npy").tolist()
                     for kind in ("intrinsic", "extrinsic")}
Path("cameras.json").write_text(json.dumps({"cameras": cameras}))
for instant in "12":
    shutil.copytree("photographs", f"instants/{instant}")
    shutil.copytree("masks", f"instant_masks/{instant}")
END"""
# A document, and the commands that make what its reader has.
BEFORE = {
    "docs/data.md": (
        f"python scripts/miniature.py data=thuman2 data.root=rendered {FEW}",
        _SCANS.format("THuman2.0_Release"),
        _PHOTOGRAPHS,
    ),
    "docs/evidence/benchmark.md": _RENDERED,
    "docs/evidence/photographs.md": _RENDERED,
    "docs/evidence/rounds.md": _RENDERED,
    "docs/extend.md": (*_RENDERED, _ABLATION),
    "docs/method.md": _RENDERED,
    "docs/performance.md": _CHECKPOINTS,
    "docs/reproduce.md": (
        _SCANS.format("THuman2.0_Release"),
        f"python scripts/miniature.py data=zju_mocap data.root=zju_mocap {FEW}",
        f"python scripts/miniature.py data=humman data.root=humman {FEW}",
        "cp humman_body_models/smpl/SMPL_NEUTRAL.pkl .",
        _SWEEP,
    ),
    "docs/photographs.md": (
        f"{_RUN} hydra.run.dir=runs/mine",
        f"python scripts/miniature.py data=thuman2 data.root=rendered {FEW} --size 112",
        _CAPTURE,
    ),
    "docs/tables.md": (_SWEEP,),
    "docs/training.md": (f"{_RUN} hydra.run.dir=runs/before", _SWEEP),
}  # fmt: skip
# Names that Python blocks of a document take as given.
GIVEN = {
    "docs/rasterizer.md": """
import torch
from ghgs_lit import Cameras, Gaussians
near, one = torch.rand(50, 3) + torch.tensor([0, 0, 2]), torch.ones(50)
gaussians = Gaussians(near, torch.rand(50, 4), torch.rand(50, 3) / 9, one / 2, torch.rand(50, 3), (50,))
cameras = Cameras(torch.tensor([[[[30.0, 0, 16], [0, 30, 16], [0, 0, 1]]]]), torch.eye(4)[None, None], 32, 32)
""",
}
# Beginnings of the commands of a document that end within seconds, and of those that they need.
FAST = {
    "README.md": r"ghgs train --help|.*dry_run=true|.*data\.source=my_scans|"
    r"ghgs prepare .*rendered|ghgs train experiment=scans .*runs/mine|"
    r"ghgs train .*trainer=gpu|ghgs predict|#python",
    "docs/rasterizer.md": r"#python",
    "docs/tables.md": r"ghgs table",
    "docs/training.md": r".*dry_run=true",
}


@dataclass(frozen=True)
class Command:
    """One command of a document; ``text`` as printed, without continuation lines and comments."""

    document: str
    line: int
    text: str
    is_python: bool = False

    @property
    def title(self) -> str:
        return f"python, {self.text.count(chr(10)) + 1} lines" if self.is_python else self.text

    @property
    def key(self) -> str:
        """What the patterns of the tables are matched with."""
        return "#python" if self.is_python else self.text

    @property
    def reason(self) -> str | None:
        """Why it is not run; None: it is."""
        return next((why for pattern, why in NOT_RUN if re.match(pattern, self.key)), None)

    @property
    def is_fast(self) -> bool:
        return self.document in FAST and re.match(FAST[self.document], self.key) is not None

    def script(self) -> tuple[str, list[str]]:
        """What is run, and the reasons for which it differs from the text."""
        given = GIVEN.get(self.document, "") if self.is_python else ""
        text, reasons = given + self.text, []
        for pattern, instead, why in SMALL:
            changed = re.sub(pattern, instead, text)
            if changed != text:
                text, reasons = changed, [*reasons, why]
        return text, reasons


def documents() -> list[str]:
    """All documents that have commands, relative to the repository."""
    found = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
    return [path.relative_to(ROOT).as_posix() for path in found]


def commands(document: str) -> list[Command]:
    """The commands of a document in the order of the text; repeated ones count once."""
    text = (ROOT / document).read_text()
    found = [*_in_blocks(document, text), *_in_prose(document, text)]
    first: dict[str, Command] = {}
    for command in sorted(found, key=lambda c: c.line):
        first.setdefault(command.text, command)
    return list(first.values())


def _in_blocks(document: str, text: str) -> Iterator[Command]:
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


def _in_prose(document: str, text: str) -> Iterator[Command]:
    """Code spans that begin like a command and have an argument;
    names of verbs alone are not run."""
    prose = _without_blocks(text)
    program = r"(?:ghgs --help|ghgs\s\w+\s\S*(?:=|--help)|python \w+/|make \w|pip install|tensorboard )"
    for span in re.finditer(rf"(?<!`)`((?:\w+=\S+ )?{program}[^`]*)`(?!`)", prose):
        yield Command(document, prose.count("\n", 0, span.start()) + 1, " ".join(span[1].split()))


def _without_blocks(text: str) -> str:
    return re.sub(r"^```.*?^```", lambda block: "\n" * block[0].count("\n"), text, flags=re.M | re.S)


def stale_figures(document: str) -> list[str]:
    """Find tables of figures that are not of today's weights and people, and commits that do not exist.

    Args:
        document: relative to the repository.

    Returns:
        A line for each fault.
    """
    text = _without_blocks((ROOT / document).read_text())
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
    """Runs commands in a folder of its own, as a reader of one document would."""

    def __init__(self, folder: Path, document: str) -> None:
        self.folder = folder / document.replace("/", "_").removesuffix(".md")
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir(parents=True)
        for name in ("docs", "scripts", "benchmarks"):
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
        """Exit code, seconds and output of a command."""
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


def check(document: str, folder: Path, fast: bool = False, listed: bool = False) -> Counter:
    """Run the commands of one document and print a line for each.

    Args:
        document: relative to the repository.
        folder: where the document's folder is made.
        fast: only what ends within seconds.
        listed: only print what would be run.

    Returns:
        How many commands ran, failed, and were left out.
    """
    count: Counter = Counter()
    chosen = [c for c in commands(document) if not fast or (c.is_fast and c.reason is None)]
    reader = Reader(folder, document)
    needs_files = [c for c in chosen if c.reason is None and not re.search(r"--help|dry_run=true", c.text)]
    if needs_files and not listed:
        for text in BEFORE.get(document, ()):
            _one(reader, f"{document} (before)", text.splitlines()[0], text, False, [], count)
    for command in chosen:
        place = f"{document}:{command.line}"
        script, reasons = command.script()
        if command.reason is not None:
            count["not run"] += 1
            print(f"not run            {place}  {command.title}  ({command.reason})", flush=True)
        elif listed:
            print(f"run                {place}  {command.title}{_why(reasons)}")
        else:
            _one(reader, place, command.title, script, command.is_python, reasons, count)
    return count


def _one(
    reader: Reader, place: str, title: str, script: str, is_python: bool, reasons: list[str], count: Counter
) -> None:
    code, seconds, output = reader.run(script, is_python)
    count["failed" if code else "ran"] += 1
    print(
        f"{'ran' if code == 0 else 'FAILED':<7}{seconds:5.0f} s {code:>4}  {place}  {title}{_why(reasons)}",
        flush=True,
    )
    if code:
        print(f"    as run: {script}\n    " + "\n    ".join(output.strip().splitlines()[-15:]), flush=True)


def _why(reasons: Sequence[str]) -> str:
    return f"  ({'; '.join(dict.fromkeys(reasons))})" if reasons else ""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("documents", nargs="*", help="relative to the repository; none: all")
    parser.add_argument(
        "--fast", action="store_true", help="only what ends within seconds, and what that needs"
    )
    parser.add_argument("--list", action="store_true", help="print what would be run")
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
            total += check(document, folder, given.fast, given.list)
    print(", ".join(f"{total[kind]} {kind}" for kind in ("ran", "failed", "not run")))
    return 1 if total["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
