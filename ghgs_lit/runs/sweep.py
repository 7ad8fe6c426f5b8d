"""Sweeps (``hydra/sweeper=grid``): plan the runs of a grid and launch the unfinished ones."""

import contextlib
import json
import logging
import re
import subprocess
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus, filter_overrides
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig, OmegaConf, open_dict

from ghgs_lit.config.compose import check_ablation, chosen_options, saved_text, to_plain
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.keys import is_hyperparameter, key_of
from ghgs_lit.config.registry import verb_class
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import require_writable, resolve_path, write_text_atomically
from ghgs_lit.parsing import read_yaml
from ghgs_lit.runs.job import BUSY, check_config, check_launcher
from ghgs_lit.runs.plan import PlannedRun, Rehearse, print_plan, print_states, shared_overrides
from ghgs_lit.runs.processes import (
    Interrupted,
    interruptible,
    print_how_to_go_on,
    queue_again,
    stop_if_interrupted,
)
from ghgs_lit.runs.results import config_hash, differences
from ghgs_lit.runs.run import PLAN, SWEPT, RunDirectory, State, runs_in_order

log = logging.getLogger(__name__)
_POLL = 2.0  # seconds between checks of runs locked by other processes
#: Words in sbatch's error messages, with the launcher keys that they concern.
_SBATCH_KEYS = {
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


Launch = Callable[[Sequence[Sequence[str]], int], Sequence[JobReturn]]


def sweep(sweeper: BasicSweeper, arguments: Sequence[str], rehearse: Rehearse) -> list[Sequence[JobReturn]]:
    """Run the grid of a command, or print its plan with ``dry_run``.

    Args:
        sweeper: Hydra's sweeper, with configuration, launcher and parameters.
        arguments: Overrides of the command line.
        rehearse: Checks the prerequisites of runs, for ``dry_run``.

    Returns:
        The jobs' return values in the form that Hydra expects.

    Raises:
        InputError: A configuration, a directory or the launcher is rejected; with ``dry_run``, something
            is missing.
        Interrupted: Ctrl-C or SIGTERM; no further run is started.
    """
    config = sweeper.config
    directory = resolve_path(str(config.hydra.sweep.dir))
    started: list[PlannedRun] = []
    try:
        with interruptible():
            planned = _plan(sweeper, arguments, directory)
            _print_differences(planned, directory)
            if config.get("dry_run"):
                print_plan(planned, directory, rehearse)
                return []
            started = planned
            write_plan(planned, config, directory)
            launch = partial(_submit, sweeper.launcher, config.hydra.launcher)
            returns = run_all(planned, launch, sweeper.max_batch_size)
    except Interrupted as stop:
        if not stop.explained:
            how = "nothing was run; to begin, the same command"
            if started:
                done = sum(item.directory.done for item in started)
                how = f"{done} of {len(started)} runs are done; to go on, the same command with"
                how += f" hydra.sweep.dir={directory}"
            print_how_to_go_on(stop, "the sweep", how, queue_again(stop.number))
        raise
    metrics = [item.directory.metric for item in planned]
    shown = ["" if metric is None else f"{metric:.2f}" for metric in metrics]
    sessions = [str(len(item.directory.sessions())) for item in planned]
    print_states(planned, {"PSNR": shown, "sessions": sessions})
    print(f"wrote {directory}", flush=True)
    for result in returns:
        _ = result.return_value  # raises what the job raised
    return [returns]


def combinations(
    params: Mapping[str, Any] | None, arguments: Sequence[str], loader: ConfigLoader | None = None
) -> list[list[str]]:
    """Overrides of each job of a grid; values on the command line replace those of the sweep.

    Args:
        params: ``hydra.sweeper.params``: comma-separated values by key; None: no values.
        arguments: Overrides of the command line.
        loader: Resolves ``glob(*)`` to the options of a group.

    Returns:
        A list of overrides for each combination of values.
    """
    parser = OverridesParser.create(config_loader=loader)
    given = parser.parse_overrides(list(arguments))
    keys = {override.get_key_element() for override in given}
    own = parser.parse_overrides([f"{k}={v}" for k, v in (params or {}).items() if k not in keys])
    (batch,) = BasicSweeper.split_arguments([*own, *given], None)
    return batch


def _plan(sweeper: BasicSweeper, arguments: Sequence[str], directory: Path) -> list[PlannedRun]:
    """Distinct runs of a sweep, after all checks that are fast; writes nothing."""
    config, batch = sweeper.config, sweeper.max_batch_size
    require(batch is None or batch >= 1, "hydra.sweeper.max_batch_size", "a number of at least 1", batch)
    verb = verb_class(sweeper.verb)
    name = f"basic for ghgs {sweeper.verb}, which is not derived from ghgs train"
    require(issubclass(verb, verb_class("train")), "hydra/sweeper", name, "grid")
    loader = sweeper.hydra_context.config_loader
    combos = combinations(sweeper.params, arguments, loader)
    planned: dict[str, PlannedRun] = {}
    for overrides in combos:
        stop_if_interrupted()
        cfg = loader.load_sweep_config(config, list(overrides))
        check_ablation(cfg, cfg.hydra)
        with open_dict(cfg):
            cfg.hydra.job.num = len(planned)
            subdirectory = str(cfg.hydra.sweep.subdir)
            hydra_node = cfg.pop("hydra")
        run = verb.of(to_plain(fill(cfg)))
        run = run.replace(chosen=chosen_options(run.plain, hydra_node))
        name = config_hash(run.plain)
        # The job writes to the planned directory, whatever job number the launcher assigns.
        places = {"dir": str(directory), "subdir": subdirectory}
        fixed = (f"hydra.sweep.{key}={_quote(place)}" for key, place in places.items())
        place = RunDirectory(directory / subdirectory, name)
        shown = tuple(filter_overrides(overrides))
        planned.setdefault(name, PlannedRun(name, (*overrides, *fixed), shown, run, place))
    if len(planned) < len(combos):
        print(f"{len(combos)} combinations, {len(planned)} different configurations", flush=True)
    runs = list(planned.values())
    _check(runs, config, directory)
    return runs


def _quote(text: str) -> str:
    """Quote text as the value of an override."""
    return "'" + re.sub(r"(\\*)('|$)", lambda match: 2 * match[1] + ("\\'" if match[2] else ""), text) + "'"


def _check(planned: Sequence[PlannedRun], config: DictConfig, directory: Path) -> None:
    """Check the launcher and the directories and, unless ``dry_run`` is set, that each run can train."""
    runs: dict[Path, PlannedRun] = {}
    for item in planned:  # an impossible launcher is rejected before anything starts
        check_launcher(item.run, config.hydra.runtime.choices["hydra/launcher"])
        other = runs.setdefault(item.directory.path, item)
        shared = f"{item.directory.path} for {' '.join(other.shown)} and {' '.join(item.shown)}"
        require(other is item, "hydra.sweep.subdir", "a directory for each configuration", shared)
        if not item.directory.done:
            item.directory.start(item.run)
    if not all(item.directory.done for item in planned):
        require_writable(directory, "hydra.sweep.dir", "the runs")
    for item in [] if config.get("dry_run") else planned:
        require(not item.run.overwrite, "overwrite", "false in a sweep, which goes on with its runs", True)
        check_config(item.run)


def _print_differences(planned: Sequence[PlannedRun], directory: Path) -> None:
    """Print the keys that differ if the directory holds a sweep to which none of these runs belongs: the
    user has probably changed a key by mistake."""
    if any(item.directory.swept for item in planned):
        return
    others = []
    for path in sorted(directory.glob(f"*/{SWEPT}")):
        with contextlib.suppress(InputError, OSError):  # a damaged run does not belong to this sweep
            others.append(differences(read_yaml(path.with_name("config.yaml")), planned[0].run.plain))
    if keys := min(others, key=len, default=[]):
        shown = ", ".join(keys[:3]) + (f" and {len(keys) - 3} more" if len(keys) > 3 else "")
        print(
            f"none of these runs was begun; {len(others)} others in {directory} differ: {shown}", flush=True
        )


def write_plan(planned: Sequence[PlannedRun], config: DictConfig, directory: Path) -> None:
    """Write each run's configuration, from which tables list planned runs, and the overrides that
    distinguish it from the other runs.

    Args:
        planned: All runs of the sweep.
        config: Configuration of the command; saved in ``multirun.yaml``, which also lists the runs.
        directory: Directory of the sweep.
    """
    shared = shared_overrides(planned)
    titles = {RunDirectory(path.parent).title for path in directory.glob(f"*/{SWEPT}")}
    for item in planned:
        place = item.directory
        if not (place.path / "config.yaml").exists():
            write_text_atomically(place.path / "config.yaml", saved_text(item.run.plain))
        if place.swept:
            continue
        swept = [o for o in item.shown if is_hyperparameter(key_of(o))]
        swept = [o for o in swept if key_of(o) == "seed" or o not in shared] or [f"run={item.name}"]
        write_text_atomically(place.path / SWEPT, json.dumps(swept))
        if place.title in titles:  # taken by a grid with other settings in the same folder
            write_text_atomically(place.path / SWEPT, json.dumps([*swept, f"run={item.name}"]))
        titles.add(place.title)
    names = dict.fromkeys([*(item.directory.path.name for item in planned), *runs_in_order(directory)])
    runs = OmegaConf.to_yaml({"runs": list(names)})
    write_text_atomically(directory / PLAN, OmegaConf.to_yaml(config) + runs)


def run_all(planned: Sequence[PlannedRun], launch: Launch, batch: int | None = None) -> list[JobReturn]:
    """Launch runs until each has finished, in any process, or failed.

    A job that returns ``BUSY`` (its run is locked by another process) is launched again once that process
    has ended.

    Args:
        planned: All runs of the sweep; finished runs are not launched.
        launch: Starts jobs, given their overrides and the number of the first.
        batch: Number of jobs at once, at least 1; None: all.

    Returns:
        The jobs' return values, in the order in which they ended.
    """
    todo = [item for item in planned if not item.directory.done]
    print(f"{len(planned)} runs: {len(planned) - len(todo)} done before, {len(todo)} to do", flush=True)
    returns: list[JobReturn] = []
    while todo:
        busy = []
        size = batch or len(todo)
        for jobs in (todo[first : first + size] for first in range(0, len(todo), size)):
            results = launch([item.overrides for item in jobs], len(returns))
            for item, result in zip(jobs, results, strict=True):
                if result.status == JobStatus.FAILED:
                    try:
                        error = result.return_value
                    except Exception as raised:
                        error = f"{type(raised).__name__}: {raised}".splitlines()[0]
                    log.error("failed: %s (%s): %s", item.directory.path, " ".join(item.shown), error)
                elif result.return_value == BUSY:
                    busy.append(item)
                    continue
                returns.append(result)
        if todo := busy:
            print(f"waiting for {', '.join(item.directory.owner for item in todo)}", flush=True)
        while todo and all(item.directory.state == State.RUNNING for item in todo):
            time.sleep(_POLL)
    return returns


def _submit(
    launcher: Launcher, options: DictConfig, jobs: Sequence[Sequence[str]], first: int
) -> Sequence[JobReturn]:
    """Launch jobs and wait for them; an error of sbatch becomes one line with the launcher's key."""
    if not type(launcher).__module__.startswith("hydra_plugins.hydra_submitit_launcher"):
        return launcher.launch(jobs, first)
    if type(launcher).__name__ == "SlurmLauncher":
        _check_accounting()
    try:
        return launcher.launch(jobs, first)
    except (RuntimeError, ValueError) as error:
        is_rejected = isinstance(error.__cause__, subprocess.CalledProcessError)
        lines = [line.removeprefix("sbatch: error: ") for line in str(error).splitlines()]
    found = "; ".join(lines[:2])
    if not is_rejected:
        logs = options.submitit_folder.replace("%j", "*")
        raise InputError(
            f"hydra.launcher: expected jobs that end with a result; found {found} (logs: {logs})"
        )
    about = (keys for word, keys in _SBATCH_KEYS.items() if re.search(rf"\b{word}", found, re.IGNORECASE))
    key = next((key for key in next(about, ()) if options.get(key) is not None), None)
    where = "hydra.launcher" if key is None else f"hydra.launcher.{key}={options[key]}"
    raise InputError(f"{where}: expected what sbatch accepts; found {found}")


def _check_accounting() -> None:
    """Keep submitit from polling ``sacct`` where SLURM has no accounting."""
    with contextlib.suppress(OSError):
        answer = subprocess.run(["sacct", "--noheader"], check=False, capture_output=True, text=True)
        if answer.returncode != 0:
            from submitit import SlurmJob

            SlurmJob.watcher._make_command = lambda: None
            message = " ".join(answer.stderr.split()) or "sacct fails"
            print(f"note: {message}: the sweep waits for jobs that are cancelled, too", flush=True)
