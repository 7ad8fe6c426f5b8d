"""Train a small sweep whose processes are killed at random, moved and requeued, and check the result.

    python scripts/drill.py --out runs/drill [--kills 10] [--steps 60] [--random 0] [overrides of ghgs train]

Two processes share twelve runs. They are killed in training by SIGKILL, SIGTERM or SIGINT. Once, all
are killed and the sweep's folder is moved; once, a SLURM job (the environment of ``srun``, a stand-in
for ``scontrol``) is stopped by SIGUSR1 and requeued. Then each run must have been trained once, with
the last and the best checkpoint, one log entry per step, and a place in the table; one is compared
bit by bit with an undisturbed run. Prints all faults, and exits with 1 if there are any.
"""

import argparse
import csv
import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch
from tensorboard.backend.event_processing.event_file_loader import EventFileLoader

VALIDATION = 6
SEEDS, ABLATIONS = (1, 2, 3, 4, 5, 6), ("full", "no_semantic")
SETTINGS = (
    *("experiment=demo", "data.people={train: 4, val: 1}", "data.size=56", "evaluation.views=[4]"),
    *(f"trainer.val_check_interval={VALIDATION}", "trainer.log_every_n_steps=1"),
    *("evaluation.pictures=0", "callbacks=steps", "callbacks.last.every_n_train_steps=5", "data.workers=0"),
)
JOB = {"SLURM_JOB_ID": "77", "SLURM_JOB_NAME": "drill", "SLURM_NTASKS": "1", "SLURM_NNODES": "1"}
JOB |= {"SLURM_NODEID": "0", "SLURM_STEP_ID": "0", "SLURM_PROCID": "0", "SLURM_LOCALID": "0"}
JOB |= {"SLURM_JOB_NODELIST": "localhost"}


class Drill:
    """The sweep's folder and its two processes."""

    def __init__(self, out: Path, steps: int, overrides: list[str]):
        overrides = [f"trainer.max_steps={steps}", *overrides]
        self.out, self.overrides, self.sweep = out, overrides, out / "sweep"
        self.processes: list[subprocess.Popen] = []
        self.requests = out / "requests"  # written by the stand-in for scontrol
        (out / "bin").mkdir(parents=True)
        (out / "bin" / "scontrol").write_text(f'#!/bin/bash\necho "$@" >> {self.requests.resolve()}\n')
        (out / "bin" / "scontrol").chmod(0o755)

    def ghgs(self, *arguments: str, **environment: str) -> subprocess.Popen:
        command = [sys.executable, "-m", "ghgs_lit.cli.main", *arguments]
        path = f"{self.out.resolve() / 'bin'}:{os.environ['PATH']}"
        with open(self.out / "log", "a") as log:
            return subprocess.Popen(
                command, stdout=log, stderr=log, env={**os.environ, "PATH": path, **environment}
            )

    def train(self, sweep: Path, seeds=SEEDS, ablations=ABLATIONS, **environment: str) -> subprocess.Popen:
        grid = (f"seed={','.join(map(str, seeds))}", f"ablation={','.join(ablations)}")
        cache = f"data.cache_dir={(self.out / 'data').resolve()}"
        where = f"hydra.sweep.dir={sweep}"
        return self.ghgs("train", "-m", *SETTINGS, *grid, cache, *self.overrides, where, **environment)

    def start_two(self) -> None:
        """Start processes until there are two, including ended ones; :meth:`finish` checks exit codes."""
        while len(self.processes) < 2:
            self.processes.append(self.train(self.sweep))

    def session_of(self, process: subprocess.Popen) -> dict | None:
        """The current session of a process; None: it is not training."""
        for path in self.sweep.glob("*/run.json"):
            sessions = json.loads(path.read_text())["sessions"]
            if sessions and sessions[-1]["pid"] == process.pid and "outcome" not in sessions[-1]:
                return sessions[-1]
        return None

    def wait_for_training(self, process: subprocess.Popen) -> bool:
        while process.poll() is None and self.session_of(process) is None:
            time.sleep(0.1)
        return process.poll() is None

    def stop(self, process: subprocess.Popen, number: int) -> None:
        process.send_signal(number)
        process.wait()
        self.processes.remove(process)

    def kill(self, kills: int, chance: random.Random) -> None:
        """Kill one of the two processes in training ``kills`` times, and start another one each time."""
        for count in range(kills):
            self.start_two()
            victim = chance.choice(self.processes)
            if not self.wait_for_training(victim):
                raise SystemExit(f"all runs were done after {count} kills: try more --steps")
            time.sleep(chance.uniform(0, 4))
            number = chance.choice([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
            self.stop(victim, number)
            print(f"kill {count + 1}: {signal.Signals(number).name}", flush=True)
            if count == kills // 3:
                self.move()
            if count == 2 * kills // 3:
                self.queue_again(chance)

    def move(self) -> None:
        for process in list(self.processes):
            self.stop(process, signal.SIGKILL)
        self.sweep = self.sweep.rename(self.out / "moved")
        print(f"moved to {self.sweep}", flush=True)

    def queue_again(self, chance: random.Random) -> None:
        job = self.train(self.sweep, **JOB)
        self.processes.append(job)
        if not self.wait_for_training(job):
            raise SystemExit("all runs were done before a job was queued again: try more --steps")
        time.sleep(chance.uniform(0, 2))
        self.stop(job, signal.SIGUSR1)
        if self.requests.read_text() != "requeue 77\n":
            raise SystemExit(f"{self.requests}: expected that the job was queued again once")
        self.processes.append(self.train(self.sweep, **JOB, SLURM_RESTART_COUNT="1"))
        print("job 77 was queued again", flush=True)

    def finish(self) -> list[str]:
        self.start_two()
        return [f"exit code {code} of the last processes" for p in self.processes if (code := p.wait()) != 0]


def steps_of_csv(run: Path, name: str) -> list[tuple[int, float]]:
    with open(run / "csv" / "metrics.csv", newline="") as file:
        return [(int(row["step"]), float(row[name])) for row in csv.DictReader(file) if row.get(name)]


def steps_of_tensorboard(folder: Path, name: str) -> list[int]:
    """Steps of a tag in all event files, including events that TensorBoard would discard."""
    events = [e for path in folder.rglob("events.*") for e in EventFileLoader(str(path)).Load()]
    return sorted(e.step for e in events for value in e.summary.value if value.tag == name)


def faults_of(run: Path, steps: int) -> list[str]:
    """Faults of a completed run."""
    every, validations = list(range(1, steps + 1)), list(range(VALIDATION, steps + 1, VALIDATION))
    results = json.loads((run / "metrics.json").read_text())
    sessions = json.loads((run / "run.json").read_text())["sessions"]
    last, best = (
        torch.load(run / "checkpoints" / f"{name}.ckpt", weights_only=True) for name in ("last", "best")
    )
    scores = steps_of_csv(run, "val/psnr")
    top = max(score for _, score in scores)
    state = next(value for key, value in last["callbacks"].items() if "val/psnr" in key)
    curves = run / "tensorboard"
    found = {
        "hash of the configuration": (results["provenance"]["config_hash"], run.name),
        "sessions that ended well": ([s["outcome"] for s in sessions if "outcome" in s].count("done"), 1),
        "step of last.ckpt": (last["global_step"], steps),
        "step of best.ckpt": (best["global_step"], next(step for step, score in scores if score == top)),
        "best score": (round(float(state["best_model_score"]), 4), round(top, 4)),
        "steps of the CSV": ([step for step, _ in steps_of_csv(run, "loss/total")], every),
        "validations of the CSV": ([step for step, _ in scores], validations),
        "steps of TensorBoard": (steps_of_tensorboard(curves, "loss/total"), every),
        "validations of TensorBoard": (steps_of_tensorboard(curves, "val/psnr"), validations),
    }
    return [f"{run.name}: {name}: {a}, expected {b}" for name, (a, b) in found.items() if a != b]


def find_differences(a: Path, b: Path) -> list[str]:
    """Names of the tensors that differ between the last weights of two runs."""
    states = [
        torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"] for run in (a, b)
    ]
    return [name for name, tensor in states[0].items() if not torch.equal(tensor, states[1][name])]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("runs/drill"))
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--steps", type=int, default=60, help="of each run; fewer on a slow machine")
    parser.add_argument("--random", type=int, default=0, help="seed of what is killed and when")
    arguments, overrides = parser.parse_known_args()
    # A shell starts background jobs with SIGINT ignored, which children inherit.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if arguments.out.exists():
        raise SystemExit(f"{arguments.out}: expected a new directory; found one")
    drill, begin = Drill(arguments.out, arguments.steps, overrides), time.monotonic()
    whole = arguments.out / "whole"
    code = drill.train(whole, SEEDS[:1], ABLATIONS[:1]).wait()
    faults = [f"exit code {code} of the undisturbed run"] * (code != 0)
    drill.kill(arguments.kills, random.Random(arguments.random))
    faults += drill.finish()
    runs = sorted(path.parent for path in drill.sweep.glob("*/metrics.json"))
    count = len(SEEDS) * len(ABLATIONS)
    faults += [f"{len(runs)} runs have results, expected {count}"] * (len(runs) != count)
    faults += [fault for run in runs for fault in faults_of(run, arguments.steps)]
    (undisturbed,) = (path.parent for path in whole.glob("*/metrics.json"))
    tensors = find_differences(undisturbed, drill.sweep / undisturbed.name)
    faults += [f"{len(tensors)} tensors differ from those of an undisturbed run"] * bool(tensors)
    table = drill.ghgs("table", f"runs={drill.sweep}", f"hydra.run.dir={arguments.out / 'table'}").wait()
    said = (arguments.out / "table" / "table.md").read_text() if table == 0 else "No results yet"
    faults += ["expected a table of all seeds"] * (
        "No results yet" in said or f"{len(SEEDS)} seeds" not in said
    )
    sessions = sum(path.read_text().count('"started"') for path in drill.sweep.glob("*/run.json"))
    print("\n".join(faults))
    print(f"{len(runs)} runs in {sessions} sessions, {len(faults)} faults, {time.monotonic() - begin:.0f} s")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
