"""Submission of a sweep's jobs to SLURM by submitit: what sbatch refuses is one line with its key."""

import contextlib
import re
import subprocess
from collections.abc import Sequence

from hydra.core.utils import JobReturn
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig

from ghgs_lit.errors import InputError

#: Words of what sbatch refuses, and the keys that they are about.
_ABOUT = {
    "partition": ("partition",),
    "gres": ("gres", "gpus_per_node", "gpus_per_task"),
    "memory": ("mem_gb", "mem_per_cpu", "mem_per_gpu"),
    "feature": ("constraint",),
    "qos": ("qos",),
    "account": ("account",),
    "cpu": ("cpus_per_task", "cpus_per_gpu"),
    "node": ("exclude", "nodelist", "nodes"),
    "time": ("timeout_min",),
}


def submit(
    launcher: Launcher, options: DictConfig, jobs: Sequence[Sequence[str]], first: int
) -> Sequence[JobReturn]:
    """Launch jobs and wait for them.

    Args:
        launcher: Hydra's.
        options: of the launcher.
        jobs: Overrides of each.
        first: Number of the first.

    Returns:
        What the jobs returned.

    Raises:
        InputError: submitit cannot submit them, or a job ended without a result.
    """
    if not type(launcher).__module__.startswith("hydra_plugins.hydra_submitit_launcher"):
        return launcher.launch(jobs, first)
    if type(launcher).__name__ == "SlurmLauncher":
        _ask_for_accounting()
    try:
        return launcher.launch(jobs, first)
    except (RuntimeError, ValueError) as error:
        is_refused = isinstance(error.__cause__, subprocess.CalledProcessError)
        lines = [line.removeprefix("sbatch: error: ") for line in str(error).splitlines()]
    found = "; ".join(lines[:2])
    if not is_refused:
        logs = options.submitit_folder.replace("%j", "*")
        raise InputError(
            f"hydra.launcher: expected jobs that end with a result; found {found} (logs: {logs})"
        )
    about = (keys for word, keys in _ABOUT.items() if re.search(rf"\b{word}", found, re.IGNORECASE))
    key = next((key for key in next(about, ()) if options.get(key) is not None), None)
    where = "hydra.launcher" if key is None else f"hydra.launcher.{key}={options[key]}"
    raise InputError(f"{where}: expected what sbatch accepts; found {found}")


def _ask_for_accounting() -> None:
    """Let submitit not call ``sacct``, which it would do all the time, where SLURM has none."""
    with contextlib.suppress(OSError):
        answer = subprocess.run(["sacct", "--noheader"], check=False, capture_output=True, text=True)
        if answer.returncode != 0:
            from submitit import SlurmJob

            SlurmJob.watcher._make_command = lambda: None
            said = " ".join(answer.stderr.split())
            print(
                f"note: {said or 'sacct fails'}: the sweep waits for jobs that are cancelled, too", flush=True
            )
