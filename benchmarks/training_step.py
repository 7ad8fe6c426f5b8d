"""Milliseconds of a training step by part, of several versions of the package in turns.

    python benchmarks/training_step.py experiment=scans data.root=/data/scans
    python benchmarks/training_step.py --packages ../before . -- experiment=scans data.root=/data/scans

The arguments are overrides of ``ghgs train``. Each round trains ``--steps`` steps with each
package in a process of its own; as many before them, which compile and fill caches, do not count.
The table has the medians of the rounds, and the loss of the last step, which versions that compute
the same share.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
from pathlib import Path

# What a process of one version runs: only names that older versions have, too.
CHILD = """
import json, logging, sys, tempfile
import lightning.pytorch as L
import torch
from ghgs_lit.config import run_of
from ghgs_lit.method.model import GHGS
from ghgs_lit.training import GHGSModule
try:
    from ghgs_lit.training.cost import Costs
except ImportError:
    from ghgs_lit.training.callbacks import Costs

steps, threads, *overrides = sys.argv[1:]
torch.set_num_threads(int(threads))
try:  # as the command line of the version does
    from ghgs_lit.runtime.allocation import keep_freed_memory
    keep_freed_memory()
except ImportError:
    pass
logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
run = run_of("train", overrides)
L.seed_everything(run.seed, workers=True, verbose=False)
data = run.data.build(views=run.views, targets=run.targets, seed=run.seed)
parts = [options.build() for options in (run.renderer, run.loss, run.optimizer)]
module = GHGSModule(GHGS.from_config(run.plain), *parts, run.plain)
found = {}

class Keep(L.Callback):
    def on_train_batch_end(self, trainer, pl_module, *args):
        if trainer.global_step == trainer.max_steps:
            values = {name: float(value) for name, value in trainer.callback_metrics.items()}
            found["ms"] = {n.split("/")[1]: v for n, v in sorted(values.items()) if n.startswith("time_ms/")}
            found["loss"] = values["loss/total"]

with tempfile.TemporaryDirectory() as folder:
    L.Trainer(
        accelerator="cpu", max_steps=2 * int(steps), max_epochs=-1, logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
        limit_val_batches=0, num_sanity_val_steps=0, log_every_n_steps=int(steps), default_root_dir=folder,
        callbacks=[Costs(), Keep()],
    ).fit(module, data)
print("RESULT" + json.dumps(found))
"""


def measure(package: Path, arguments: argparse.Namespace) -> dict:
    """Milliseconds by part and the last loss of one process."""
    numbers = [str(n) for n in (arguments.steps, arguments.threads)]
    run = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", CHILD, *numbers, *arguments.overrides],
        cwd=package,  # the first place where python -c looks for modules
        env={**os.environ, "PYTHONPATH": str(package)},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = [line for line in run.stdout.splitlines() if line.startswith("RESULT")]
    if not lines:
        sys.exit(run.stdout + run.stderr)
    return json.loads(lines[0].removeprefix("RESULT"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packages", nargs="+", type=Path, default=[Path(__file__).parents[1]])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("overrides", nargs="*")
    arguments = parser.parse_args()
    packages = [package.resolve() for package in arguments.packages]
    found = {package: [] for package in packages}
    for _ in range(arguments.rounds):
        for package in packages:
            found[package].append(measure(package, arguments))
    print(f"{'part':12}", *(f"{package.name:>14}" for package in packages), "   ms, medians")
    for part in found[packages[-1]][0]["ms"]:
        medians = [
            statistics.median(one["ms"].get(part, 0.0) for one in found[package]) for package in packages
        ]
        print(f"{part:12}", *(f"{ms:14.1f}" for ms in medians))
    print(f"{'loss':12}", *(f"{found[package][-1]['loss']:14.6f}" for package in packages))


if __name__ == "__main__":
    main()
