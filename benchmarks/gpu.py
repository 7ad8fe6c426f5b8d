r"""All measurements of the first minutes on a GPU, as one prepared script for rented machines.

    python benchmarks/gpu.py --dry first second          # rehearse on the pretend device of the tests
    python benchmarks/gpu.py first                       # 420 s: predictions, steps, kernels, loader
    python benchmarks/gpu.py second                      # 240 s of training after at most 180 of preparation
    python benchmarks/gpu.py --seconds 570 step prediction loader training    # within ten minutes
    python benchmarks/gpu.py --table runs/gpu            # print the tables of earlier runs

Each section is a process with a time limit. Results are appended to ``<out>/<run>.jsonl``
immediately; a section that fails or exceeds its limit is a row with its last lines, and the others
continue. Sections on the command line are one run, in their order, except that a section that must
wait for people lets the next one pass; ``--seconds`` limits the run. Whether replayed results agree
with eager calls, for other inputs than the captured ones, is a row with a verdict; wrong ones are
printed last, and the exit status is 1. In the background, gsplat is compiled (its kernels for up to 9
channels, for this GPU) and built-in people are rendered on all cores; they are paused during sections
that a busy host would distort. Both are stored in ``--work``, where later calls reuse them.

A compiled gsplat can be brought along. Build it on a machine with nvcc 13, and with the Python and
PyTorch versions of the one with the GPU (three minutes on two cores for one architecture and kernels
for up to 9 channels):

    TORCH_CUDA_ARCH_LIST="9.0" pip install --no-build-isolation --no-deps --no-binary gsplat \
        --target gsplat_built gsplat==1.5.3
    python benchmarks/gpu.py --gsplat gsplat_built first

``second`` trains ``experiment=shipped`` with batches of eight; further overrides follow its name.
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

GSPLAT, PEOPLE = "gsplat", "people"
CHANNELS = 9  #: Largest number of channels of compiled kernels of gsplat
LAST_LINES = 12  #: printed for a failed section


@dataclass(frozen=True)
class Plan:
    """Conditions of a section.

    ``seconds``: its limit. ``needs``: background processes that must end first. ``quiet``: pause the
    background meanwhile. ``patience``: seconds to wait for more people than the first ones.
    """

    seconds: int
    needs: tuple[str, ...] = ()
    quiet: bool = False
    patience: int = 0


#: By importance; a section that must wait for its needs lets the next one pass.
PLANS = {
    "machine": Plan(40),
    "step": Plan(100, (GSPLAT,), quiet=True),
    "prediction": Plan(100, (GSPLAT,), quiet=True),
    "paper": Plan(75),
    "frozen": Plan(60, (GSPLAT,)),
    "loader": Plan(75, (GSPLAT, PEOPLE), quiet=True),
    "kernels": Plan(75, (GSPLAT,)),
    "training": Plan(240, (GSPLAT, PEOPLE), patience=150),
}
#: Runs: sections, and seconds in total.
RUNS = {
    "first": ([name for name in PLANS if name != "training"], 420),
    "second": (["machine", "training"], 440),
}


class Background:
    """A background process in a separate session, whose output is kept in a file."""

    def __init__(self, command: list[str], environment: dict[str, str]):
        self.log = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self.process = subprocess.Popen(
            command, env=environment, stdout=self.log, stderr=subprocess.STDOUT, start_new_session=True
        )

    def is_running(self) -> bool:
        return self.process.poll() is None

    def send(self, number: signal.Signals) -> None:
        """Send a signal to the process and its children, if it is running."""
        if self.is_running():
            os.killpg(self.process.pid, number)

    def wait(self, seconds: float) -> bool:
        """Wait up to ``seconds``; kill the process if it has not ended. Returns whether it ended in time."""
        try:
            self.process.wait(max(seconds, 0))
        except subprocess.TimeoutExpired:
            self.stop()
            return False
        return True

    def stop(self) -> None:
        self.send(signal.SIGCONT)
        self.send(signal.SIGKILL)
        self.process.wait()

    def last_lines(self) -> list[str]:
        self.log.seek(0)
        lines = [line.rstrip()[:300] for line in self.log if line.strip()]
        return lines[-LAST_LINES:]


class Session:
    """Sections of a run, one after another, and the background processes."""

    def __init__(self, options: argparse.Namespace, rows: Rows, plans: dict[str, Plan], seconds: float):
        self.options, self.rows, self.plans = options, rows, plans
        self.scale = math.inf if options.dry else 1  # a rehearsal has no limits
        self.started, self.end = time.monotonic(), time.monotonic() + self.scale * seconds
        self.environment = environment_of(options)
        needs = {need for plan in plans.values() for need in plan.needs}
        self.background = {need: Background(self.command(need), self.environment) for need in sorted(needs)}

    def command(self, section: str) -> list[str]:
        options = self.options
        if section == GSPLAT:
            return [sys.executable, "-c", "pass" if options.dry else BUILD, str(options.work)]
        own = ["--section", section, "--out", str(self.rows.file), "--work", str(options.work)]
        dry = ["--dry"] if options.dry else []
        nice = ["nice", "-n", "19"] if section == PEOPLE else []
        return [*nice, sys.executable, __file__, *own, *dry, *options.overrides]

    def run(self) -> None:
        waiting = dict(self.plans)
        try:
            while waiting and time.monotonic() < self.end:
                ready = [name for name, plan in waiting.items() if self.is_ready(plan)]
                if not ready:
                    time.sleep(0.2)
                    continue
                plan = waiting.pop(ready[0])
                self.measure(ready[0], plan)
            for name in waiting:
                self.note(name, "no time was left", 0.0, [])
        finally:
            for process in self.background.values():
                process.stop()

    def is_ready(self, plan: Plan) -> bool:
        """Whether the needs of a section are met, or never will be."""
        if GSPLAT in plan.needs and self.background[GSPLAT].is_running():
            return False
        if PEOPLE not in plan.needs or not self.background[PEOPLE].is_running():
            return True
        is_first_there = any(row["section"] == PEOPLE and "numbers" in row for row in self.rows.read())
        return is_first_there and time.monotonic() - self.started >= plan.patience

    def measure(self, name: str, plan: Plan) -> None:
        """Run a section and add a row with its status."""
        for need in plan.needs:
            process = self.background[need]
            if need == PEOPLE and plan.patience:
                process.stop()  # frees its cores
            elif not process.is_running() and process.process.returncode:
                self.note(name, f"{need} failed", 0.0, process.last_lines())
                return
        for process in self.background.values():
            process.send(signal.SIGSTOP if plan.quiet else signal.SIGCONT)
        begun = time.monotonic()
        section = Background(self.command(name), self.environment)
        try:
            in_time = section.wait(min(self.scale * plan.seconds, self.end - begun))
        finally:  # also when the whole command is terminated
            section.stop()
        status = "done" if section.process.returncode == 0 else "failed" if in_time else "took too long"
        self.note(name, status, time.monotonic() - begun, [] if status == "done" else section.last_lines())
        for process in self.background.values():
            process.send(signal.SIGCONT)

    def note(self, section: str, status: str, seconds: float, last_lines: list[str]) -> None:
        self.rows.add(section=section, status=status, s=seconds, last_lines=last_lines)
        print(f"{time.monotonic() - self.started:6.0f} s  {section}: {status}", *last_lines[-1:], flush=True)


#: Importing gsplat compiles it.
BUILD = "from gsplat.cuda._backend import _C; assert _C is not None, 'gsplat found no CUDA compiler'"


def environment_of(options: argparse.Namespace) -> dict[str, str]:
    """Environment variables of all processes: paths of gsplat, its build and the people."""
    root = str(Path(__file__).resolve().parents[1])
    paths = [root, *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    if options.gsplat is not None:
        paths.insert(0, str(options.gsplat))
    elif not options.dry and (found := importlib.util.find_spec("gsplat")) is not None:
        paths.insert(
            0, str(copy_with_fewer_channels(Path(found.origin).parent, options.work / "gsplat_source"))
        )
    defaults = {"TORCH_EXTENSIONS_DIR": str(options.work / "extensions"), "GHGS_CACHE": str(options.work)}
    defaults |= {"MAX_JOBS": str(os.cpu_count()), "PYTHONUNBUFFERED": "1"}
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
        call = Call(gpu, Rows(options.out), options.section, sizes, options.work, options.overrides)
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
    lines, hidden = [], ("section", "status", "last_lines", "longest", "numbers")
    for name, section in SECTIONS.items():
        own = [row for row in found if row["section"] == name]
        ends, rows = ([row for row in own if ("row" in row) == has] for has in (False, True))
        title = (
            f"{section.__doc__.strip()} ({', '.join(row['status'] for row in ends) or 'in the background'})"
        )
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
    parser.add_argument("names", nargs="*", help=f"{', '.join(RUNS)}, sections, overrides of the training")
    parser.add_argument("--out", type=Path, default=Path(os.environ.get("OUT", "runs/gpu")))
    parser.add_argument("--work", type=Path, default=Path(tempfile.gettempdir()) / "ghgs_gpu")
    parser.add_argument("--gsplat", type=Path, help="folder of a compiled gsplat")
    parser.add_argument("--dry", action="store_true", help="rehearse without a GPU, with small sizes")
    parser.add_argument("--table", type=Path, metavar="FOLDER", help="print the tables of files, no more")
    parser.add_argument("--seconds", type=float, default=math.inf, help="limit of a run")
    parser.add_argument("--section", help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.overrides = [name for name in options.names if "=" in name]
    options.names = [name for name in options.names if "=" not in name]
    unknown = set(options.names) - set(RUNS) - set(PLANS)
    if unknown:
        parser.error(f"expected {', '.join([*RUNS, *PLANS])}; found {', '.join(sorted(unknown))}")
    return options


def runs_of(names: list[str]) -> dict[str, tuple[list[str], float]]:
    """Sections and seconds of runs by name; sections on the command line are one run."""
    runs = {name: RUNS[name] for name in names if name in RUNS}
    sections = [name for name in names if name in PLANS]
    if sections:
        runs["_".join(sections)] = (sections, sum(PLANS[name].seconds for name in sections) + 180)
    return runs


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
    try:
        for name, (sections, seconds) in runs_of(options.names or ["first"]).items():
            file = options.out / f"{name}.jsonl"
            file.unlink(missing_ok=True)
            plans = {section: PLANS[section] for section in sections}
            Session(options, Rows(file), plans, min(seconds, options.seconds)).run()
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
