"""Train, kill with -9, resume, and compare the weights bit for bit with those of an undisturbed run.

    python scripts/check_resume.py --steps 40 --kill-at 20 --out runs/check_resume [overrides of ghgs train]

Exits with 1 if a tensor of the model or the optimizer differs. On a CPU none may differ; on a GPU the last
digits can, because sums are computed in another order.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import torch


def command(directory: Path, arguments: argparse.Namespace, *more: str) -> list[str]:
    """``ghgs train`` with frequent checkpoints;
    schedules count steps, as time is not repeatable."""
    return [
        *(sys.executable, "-m", "ghgs_lit.cli.main", "train"),
        *(f"trainer.max_steps={arguments.steps}", "trainer.max_time=null"),
        *(f"trainer.val_check_interval={max(2, arguments.steps // 4)}", "evaluation.pictures=0"),
        f"callbacks.last.every_n_train_steps={arguments.every}",
        *(*arguments.overrides, f"hydra.run.dir={directory}", *more),
    ]


def read(directory: Path) -> dict | None:
    path = directory / "checkpoints" / "last.ckpt"
    return torch.load(path, weights_only=True, map_location="cpu") if path.exists() else None


def train_and_kill(directory: Path, arguments: argparse.Namespace) -> int:
    """Kill the run and its processes soon after step ``kill_at``;
    returns the step of its last checkpoint."""
    with open(directory.with_suffix(".log"), "w") as log:
        process = subprocess.Popen(
            command(directory, arguments), stdout=log, stderr=log, start_new_session=True
        )
        while process.poll() is None and ((read(directory) or {}).get("global_step", 0) < arguments.kill_at):
            time.sleep(0.02)
        if process.poll() is not None:
            raise SystemExit(f"the run ended before it could be killed; see {log.name}")
        time.sleep(arguments.delay)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    return read(directory)["global_step"]


def tensors(checkpoint: dict) -> dict[str, torch.Tensor]:
    """The tensors of the model and the optimizer by name."""
    found = dict(checkpoint["state_dict"])
    for index, state in checkpoint["optimizer_states"][0]["state"].items():
        found |= {f"optimizer.{index}.{name}": value for name, value in state.items()}
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--kill-at", type=int, default=20)
    parser.add_argument("--every", type=int, default=7, help="steps between checkpoints")
    parser.add_argument("--delay", type=float, default=0.5, help="seconds from that checkpoint to the kill")
    parser.add_argument("--out", type=Path, default=Path("runs/check_resume"))
    arguments, arguments.overrides = parser.parse_known_args()
    if arguments.out.exists():
        raise SystemExit(f"{arguments.out}: expected a new directory; found one")
    whole, cut = arguments.out / "whole", arguments.out / "cut"
    whole.mkdir(parents=True)
    with open(whole.with_suffix(".log"), "w") as log:
        subprocess.run(command(whole, arguments), check=True, stdout=log, stderr=log)
    left = train_and_kill(cut, arguments)
    print(f"killed -9; the last checkpoint is of step {left} of {arguments.steps}", flush=True)
    resume = f"resume={cut}/checkpoints/last.ckpt"
    with open(cut.with_suffix(".log"), "a") as log:
        subprocess.run(command(cut, arguments, resume), check=True, stdout=log, stderr=log)
    a, b = (tensors(read(directory)) for directory in (whole, cut))
    differing = [name for name in a.keys() | b.keys() if name not in b or not torch.equal(a[name], b[name])]
    print(f"{len(a)} tensors of the model and the optimizer, {len(differing)} differ", *differing[:5])
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
