"""Kill a sweep with -9 twice, resume it, extend it: every run must end exactly once.

    python scripts/kill_sweep.py --directory runs/kill_sweep

Eight short runs (four ablations, two seeds; photographs of 56 x 56 pixels). The first process dies
while it writes a checkpoint of the third run, the second while it trains the sixth; the third finishes the
sweep. Then a seed is added, and two processes share the new runs. At the end the interrupted runs are trained
again without interruption, and their weights are compared. Takes a few minutes.
"""

import argparse
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch

from ghgs_lit.runs.run import RunDirectory

STEPS, EVERY = 12, 4
TINY = (
    "data.people={train:2,val:2}",
    "data.size=56",
    "data.render.samples=1",
    f"trainer.max_steps={STEPS}",
    f"trainer.val_check_interval={STEPS}",
    f"callbacks.last.every_n_train_steps={EVERY}",
    "callbacks=default",
    "logger=none",
    "evaluation.targets=[release]",
    "evaluation.pictures=0",
    "recalibration.k=4",
)
GRID = ("ablation=full,no_unprojection,no_semantic,neither",)
# Runs the command line, but dies in the middle of a write of the third run's last checkpoint.
DYING = """
import io, os, signal, sys, torch
save, folders = torch.save, []
def dying(content, file, *more, **named):
    path = str(file if isinstance(file, os.PathLike) else getattr(file, "name", file))
    if "last" in os.path.basename(path):
        folders.append(os.path.dirname(path))
    if len(set(folders)) == 3 and folders.count(folders[-1]) == 2:
        whole = io.BytesIO()
        save(content, whole)
        with open(path, "wb") as half:
            half.write(whole.getvalue()[: whole.tell() // 2])
        os.kill(os.getpid(), signal.SIGKILL)
    save(content, file, *more, **named)
torch.save = dying
from ghgs_lit.cli.main import main
sys.argv[0] = "ghgs"
sys.exit(main())
"""


def command(sweep: Path, *overrides: str, dying: bool = False) -> list[str]:
    python = [sys.executable, "-c", DYING] if dying else [sys.executable, "-m", "ghgs_lit"]
    return [*python, "train", "-m", *TINY, *GRID, *overrides, f"hydra.sweep.dir={sweep}"]


def start(sweep: Path, *overrides: str, dying: bool = False) -> subprocess.Popen:
    log = open(sweep.parent / f"{sweep.name}.log", "a")  # noqa: SIM115
    return subprocess.Popen(command(sweep, *overrides, dying=dying), stdout=log, stderr=log)


def finish(process: subprocess.Popen, expected: int) -> None:
    code = process.wait()
    if code != expected:
        sys.exit(f"expected exit code {expected}; found {code}")


def kill_in_sixth(process: subprocess.Popen, sweep: Path) -> None:
    """SIGKILL as soon as five runs are done and the sixth has a checkpoint."""
    while process.poll() is None:
        done = {p.parent for p in sweep.glob("*/metrics.json")}
        begun = {p.parent.parent for p in sweep.glob("*/checkpoints/last.ckpt")}
        if len(done) == 5 and begun - done:
            process.send_signal(signal.SIGKILL)
            return
        time.sleep(0.005)
    sys.exit("the sweep ended before it was killed: increase STEPS")


def report(sweep: Path) -> list[Path]:
    """Print the sessions of each run; returns the runs that were interrupted."""
    interrupted = []
    print(f"{'run':<14}{'sessions':>9}{'ended well':>12}  steps of each session (?: killed)")
    for run in sorted(
        (p.parent for p in sweep.glob("*/metrics.json")), key=lambda r: (r / "config.yaml").name
    ):
        each = RunDirectory(run).sessions()
        ends = sum(s.get("outcome") == "done" for s in each)
        steps = ", ".join(str(s.get("steps", "?")) for s in each)
        print(f"{run.name:<14}{len(each):>9}{ends:>12}  {steps}")
        if ends != 1:
            sys.exit(f"{run}: expected to end once; found {ends}")
        if len(each) > 1:
            interrupted.append(run)
    return interrupted


def weights(run: Path) -> dict[str, torch.Tensor]:
    return torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def table(sweep: Path, title: str) -> None:
    out = sweep.parent / title.replace(" ", "_")
    verb = [
        sys.executable,
        "-m",
        "ghgs_lit",
        "table",
        f"sweep={sweep}",
        "layout=table4",
        "evaluation.views=[4]",
    ]
    subprocess.run([*verb, "reported=false", f"hydra.run.dir={out}"], check=True, stdout=subprocess.DEVNULL)
    print(f"\n{title}\n{(out / 'table.md').read_text()}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--directory", type=Path, default=Path("runs/kill_sweep"))
    root = parser.parse_args().directory.resolve()
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir(parents=True)
    sweep, seeds = root / "sweep", "seed=1,2"

    finish(start(sweep, seeds, dying=True), -signal.SIGKILL)
    half = next(sweep.glob("*/checkpoints/.last.ckpt*"))
    print(f"killed while {half.relative_to(root)} was written: {half.stat().st_size} bytes are there")
    second = start(sweep, seeds)
    kill_in_sixth(second, sweep)
    finish(second, -signal.SIGKILL)
    print(f"killed again: {len(list(sweep.glob('*/metrics.json')))} runs are done")
    table(sweep, "table after two kills")
    finish(start(sweep, seeds), 0)
    report(sweep)
    table(sweep, "table of the whole sweep")

    before = {p: p.stat().st_mtime_ns for p in sweep.glob("*/metrics.json")}
    both = [start(sweep, "seed=1,2,3") for _ in range(2)]
    for process in both:
        finish(process, 0)
    if any(path.stat().st_mtime_ns != time_before for path, time_before in before.items()):
        sys.exit("a finished run was written again")
    print(
        f"one seed more: {len(list(sweep.glob('*/metrics.json'))) - len(before)} runs added by two processes"
    )
    interrupted = report(sweep)
    pids = {
        s["pid"]
        for p in sweep.glob("*/metrics.json")
        if p not in before
        for s in RunDirectory(p.parent).sessions()
    }
    print(f"{len(pids)} processes shared them")
    table(sweep, "table of the grown sweep")

    whole = root / "uninterrupted"
    finish(start(whole, seeds), 0)
    for run in interrupted:
        ours, theirs = weights(run), weights(whole / run.name)
        equal = all(torch.equal(ours[key], theirs[key]) for key in theirs)
        print(f"{run.name}: interrupted, then resumed; weights equal to those without interruption: {equal}")
        if not equal:
            sys.exit(1)


if __name__ == "__main__":
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    main()
