r"""All measurements of the first minutes on a GPU, as one prepared script for rented machines.

    python benchmarks/gpu.py --dry                       # rehearse on the pretend device of the tests
    python benchmarks/gpu.py                             # all sections, within 420 s
    python benchmarks/gpu.py --seconds 250 step kernels  # some sections
    python benchmarks/gpu.py --table runs/gpu            # print the tables of earlier runs

Each section is a process with a time limit. Results are appended to ``<out>/<run>.jsonl``
immediately; a section that fails or exceeds its limit is a row with its last lines, and the others
continue. Sections run in their order on the command line, except that one that must wait for gsplat
lets the next one pass; ``--seconds`` limits the run. Whether replayed results agree with eager calls,
for other inputs than the captured ones, is a row with a verdict; wrong ones are printed last, and the
exit status is 1. In the background, gsplat is compiled (its kernels for up to 9 channels, for this GPU)
into ``--work``, where later calls reuse it.

A compiled gsplat can be brought along. Build it on a machine with nvcc 13, and with the Python and
PyTorch versions of the one with the GPU (three minutes on two cores for one architecture and kernels
for up to 9 channels):

    TORCH_CUDA_ARCH_LIST="9.0" pip install --no-build-isolation --no-deps --no-binary gsplat \
        --target gsplat_built gsplat==1.5.3
    python benchmarks/gpu.py --gsplat gsplat_built
"""

import argparse
import importlib.util
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.gpu_measure import DRY, Call, Gpu, Rows, Sizes, reason, rehearsal
from benchmarks.gpu_replay import WRONG
from benchmarks.gpu_sections import SECTIONS

GSPLAT = "gsplat"
CHANNELS = 9  #: Largest number of channels of compiled kernels of gsplat
LAST_LINES = 12  #: printed for a failed section


@dataclass(frozen=True)
class Plan:
    """Conditions of a section.

    ``seconds``: its limit. ``needs_gsplat``: its compilation must end first.
    """

    seconds: int
    needs_gsplat: bool = False


#: By importance; a section that must wait for gsplat lets the next one pass.
PLANS = {
    "machine": Plan(40),
    "step": Plan(100, True),
    "prediction": Plan(100, True),
    "paper": Plan(75),
    "frozen": Plan(60, True),
    "kernels": Plan(75, True),
}
SECONDS = 420  #: of a run


class Background:
    """A background process in a separate session, whose output is kept in a file."""

    def __init__(self, command: list[str], environment: dict[str, str]):
        self.log = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self.process = subprocess.Popen(
            command, env=environment, stdout=self.log, stderr=subprocess.STDOUT, start_new_session=True
        )

    def is_running(self) -> bool:
        return self.process.poll() is None

    def wait(self, seconds: float) -> bool:
        """Wait up to ``seconds``; kill the process if it has not ended. Returns whether it ended in time."""
        try:
            self.process.wait(max(seconds, 0))
        except subprocess.TimeoutExpired:
            self.stop()
            return False
        return True

    def stop(self) -> None:
        """Kill the process and its children, if it is running."""
        if self.is_running():
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def last_lines(self) -> list[str]:
        self.log.seek(0)
        lines = [line.rstrip()[:300] for line in self.log if line.strip()]
        return lines[-LAST_LINES:]


class Session:
    """Sections of a run, one after another, while gsplat is compiled if one of them needs it."""

    def __init__(self, options: argparse.Namespace, rows: Rows, plans: dict[str, Plan], seconds: float):
        self.options, self.rows, self.plans = options, rows, plans
        self.scale = math.inf if options.dry else 1  # a rehearsal has no limits
        self.started, self.end = time.monotonic(), time.monotonic() + self.scale * seconds
        self.environment = environment_of(options)
        is_needed = any(plan.needs_gsplat for plan in plans.values())
        self.gsplat = Background(self.command(GSPLAT), self.environment) if is_needed else None

    def command(self, section: str) -> list[str]:
        options = self.options
        if section == GSPLAT:
            return [sys.executable, "-c", "pass" if options.dry else BUILD]
        own = ["--section", section, "--out", str(self.rows.file), "--work", str(options.work)]
        return [sys.executable, __file__, *own, *["--dry"] * options.dry]

    def run(self) -> None:
        waiting = dict(self.plans)
        try:
            while waiting and time.monotonic() < self.end:
                is_compiling = self.gsplat is not None and self.gsplat.is_running()
                ready = [name for name, plan in waiting.items() if not (plan.needs_gsplat and is_compiling)]
                if not ready:
                    time.sleep(0.2)
                    continue
                self.measure(ready[0], waiting.pop(ready[0]))
            for name in waiting:
                self.note(name, "no time was left", 0.0, [])
        finally:
            if self.gsplat is not None:
                self.gsplat.stop()

    def measure(self, name: str, plan: Plan) -> None:
        """Run a section and add a row with its status."""
        if plan.needs_gsplat and self.gsplat.process.returncode:
            self.note(name, f"{GSPLAT} failed", 0.0, self.gsplat.last_lines())
            return
        begun = time.monotonic()
        section = Background(self.command(name), self.environment)
        try:
            in_time = section.wait(min(self.scale * plan.seconds, self.end - begun))
        finally:  # also when the whole command is terminated
            section.stop()
        status = "done" if section.process.returncode == 0 else "failed" if in_time else "took too long"
        self.note(name, status, time.monotonic() - begun, [] if status == "done" else section.last_lines())

    def note(self, section: str, status: str, seconds: float, last_lines: list[str]) -> None:
        self.rows.add(section=section, status=status, s=seconds, last_lines=last_lines)
        print(f"{time.monotonic() - self.started:6.0f} s  {section}: {status}", *last_lines[-1:], flush=True)


#: Importing gsplat compiles it.
BUILD = "from gsplat.cuda._backend import _C; assert _C is not None, 'gsplat found no CUDA compiler'"


def environment_of(options: argparse.Namespace) -> dict[str, str]:
    """Environment variables of all processes: paths of gsplat and its build."""
    root = str(Path(__file__).resolve().parents[1])
    paths = [root, *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    if options.gsplat is not None:
        paths.insert(0, str(options.gsplat))
    elif not options.dry and (found := importlib.util.find_spec("gsplat")) is not None:
        paths.insert(
            0, str(copy_with_fewer_channels(Path(found.origin).parent, options.work / "gsplat_source"))
        )
    defaults = {"TORCH_EXTENSIONS_DIR": str(options.work / "extensions"), "PYTHONUNBUFFERED": "1"}
    defaults["MAX_JOBS"] = str(os.cpu_count())
    return {**defaults, **os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}


def copy_with_fewer_channels(package: Path, folder: Path) -> Path:
    """Copy gsplat to ``folder`` without its kernels for many channels, to compile in a third of the time."""
    if not folder.exists():
        shutil.copytree(package, folder / package.name)
        for file in folder.glob("*/cuda/csrc/*.c*"):
            lines = file.read_text().splitlines()
            file.write_text("\n".join(line for line in lines if not is_for_many_channels(line)) + "\n")
    return folder


def is_for_many_channels(line: str) -> bool:
    """Whether a line of gsplat's sources instantiates or launches an excluded kernel."""
    found = re.fullmatch(r"\s*__(?:INS|LAUNCH_KERNEL)__\((\d+)\)", line)
    return found is not None and int(found[1]) > CHANNELS


def run_section(options: argparse.Namespace) -> None:
    """Run one section in this process."""
    real = nullcontext(Gpu(torch.device("cuda"), is_real=True))
    with rehearsal() if options.dry else real as gpu:
        sizes = DRY if options.dry else Sizes()
        call = Call(gpu, Rows(options.out), options.section, sizes)
        try:
            SECTIONS[options.section](call)
        except Exception as error:
            traceback.print_exc()
            sys.exit(reason(error))


def format_value(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value).replace("|", "/")


def table(rows: list[dict[str, Any]]) -> list[str]:
    """Format rows as Markdown, with a column for each of their numbers."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    return lines + [
        f"| {' | '.join(format_value(row.get(column, '')) for column in columns)} |" for row in rows
    ]


def report(found: list[dict[str, Any]]) -> str:
    """Tables of all sections, and the longest kernels of each row that has them."""
    lines, hidden = [], ("section", "status", "last_lines", "longest")
    for name, section in SECTIONS.items():
        own = [row for row in found if row["section"] == name]
        ends, rows = ([row for row in own if ("row" in row) == has] for has in (False, True))
        title = f"{section.__doc__.strip()} ({', '.join(row['status'] for row in ends)})"
        if own:
            lines.append(f"\n## {title}\n")
        if rows:
            keep = [{key: row[key] for key in row if key not in hidden} for row in rows]
            lines += table(keep)
        lines += [f"    {line}" for row in ends for line in row["last_lines"]]
        for row in rows:
            if row.get("longest") and ":" not in row["row"]:
                heads = ("kernel", "calls", "ms")
                longest = [dict(zip(heads, kernel, strict=True)) for kernel in row["longest"][:10]]
                lines += [f"\nLongest kernels: {row['row']}\n", *table(longest)]
    return "\n".join(lines)


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("sections", nargs="*", default=list(PLANS), help=", ".join(PLANS))
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", "runs/gpu")))
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "ghgs_gpu")
    parser.add_argument("--gsplat", type=Path, help="folder of a compiled gsplat")
    parser.add_argument("--dry", action="store_true", help="rehearse without a GPU, with small sizes")
    parser.add_argument("--table", type=Path, metavar="FOLDER", help="print the tables of files, no more")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="limit of all sections together")
    parser.add_argument("--section", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if unknown := set(options.sections) - set(PLANS):
        parser.error(f"expected {', '.join(PLANS)}; found {', '.join(sorted(unknown))}")
    return options


def main() -> None:
    options = arguments()
    if options.section:
        run_section(options)
        return
    if options.table is not None:
        show(options.table)
        return
    if not options.dry and not torch.cuda.is_available():
        sys.exit("device: expected a CUDA device, or --dry; found none")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("ended by a limit of time"))
    options.out.mkdir(parents=True, exist_ok=True)
    options.work.mkdir(parents=True, exist_ok=True)
    file = options.out / f"{'_'.join(options.sections)}.jsonl"
    file.unlink(missing_ok=True)
    try:
        plans = {section: PLANS[section] for section in options.sections}
        Session(options, Rows(file), plans, options.seconds).run()
    finally:
        show(options.out)


def show(folder: Path) -> None:
    """Print the tables of all files; the exit status is 1 if a verdict is wrong."""
    wrong = []
    for file in sorted(folder.glob("*.jsonl")):
        rows = Rows(file).read()
        print(f"\n# {file.stem}\n{report(rows)}")
        wrong += [f"{file.stem}: {row['row']}" for row in rows if row.get("verdict") == WRONG]
    if wrong:
        sys.exit("\nWRONG, a replay is not as eager:\n" + "\n".join(wrong))


if __name__ == "__main__":
    main()
