"""Sweeps (``hydra/sweeper=grid``): plan the runs of a grid and launch the unfinished ones."""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Quote, QuotedString
from hydra.core.utils import JobReturn, JobStatus, filter_overrides
from hydra.plugins.launcher import Launcher
from omegaconf import DictConfig, OmegaConf, open_dict
from tabulate import tabulate

from ghgs_lit.config.compose import check_ablation, chosen_options, saved_text, to_plain
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.registry import verb_class
from ghgs_lit.config.run import Run
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import require_writable, resolve_path, write_text_atomically
from ghgs_lit.runs.job import BUSY, check_config, check_launcher
from ghgs_lit.runs.processes import Interrupted, interruptible, print_how_to_go_on, stop_if_interrupted
from ghgs_lit.runs.results import config_hash
from ghgs_lit.runs.run import PLAN, RunDirectory, runs_in_order

log = logging.getLogger(__name__)
_POLL = 2.0  # seconds between checks of runs locked by other processes
_OUTPUTS = "config.yaml, checkpoints/, metrics.json, run.json, pictures and logs"


@dataclass(frozen=True)
class PlannedRun:
    """One run of a sweep.

    Attributes:
        overrides: Hydra overrides of the job, including those that set its directory.
        run: Configuration of the run.
        directory: Directory of the run.
    """

    overrides: tuple[str, ...]
    run: Run
    directory: RunDirectory

    @property
    def shown(self) -> list[str]:
        """Overrides to print, without those of Hydra."""
        return filter_overrides(self.overrides)


Launch = Callable[[Sequence[Sequence[str]], int], Sequence[JobReturn]]
Rehearse = Callable[[Sequence[PlannedRun]], Sequence[str]]
"""Function that checks the prerequisites of runs and returns one line for everything that is missing."""


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
    try:
        with interruptible():
            planned = _make_plan(sweeper, arguments, directory)
            _check(planned, config, directory)
            if config.get("dry_run"):
                print_plan(planned, directory, rehearse)
                return []
            write_plan(planned, config, directory)
            returns = run_all(planned, partial(_launch, sweeper.launcher))
    except Interrupted as stop:
        if not stop.explained:  # by the run
            print_how_to_go_on(stop, "the sweep", f"hydra.sweep.dir={directory}")
        raise
    print_states(planned)
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


def _make_plan(sweeper: BasicSweeper, arguments: Sequence[str], directory: Path) -> list[PlannedRun]:
    """Distinct runs of a sweep; writes nothing."""
    config = sweeper.config
    verb = verb_class("train")
    loader = sweeper.hydra_context.config_loader
    planned: dict[str, PlannedRun] = {}
    grid = combinations(sweeper.params, arguments, loader)
    for overrides in grid:
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
        fixed = (
            f"hydra.sweep.{key}={QuotedString(text, Quote.single).with_quotes()}"
            for key, text in places.items()
        )
        place = RunDirectory(directory / subdirectory, name)
        item = PlannedRun((*overrides, *fixed), run, place)
        planned.setdefault(name, item)
    if len(grid) > len(planned):
        print(f"{len(grid)} combinations, {len(planned)} different configurations", flush=True)
    return list(planned.values())


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


def print_states(planned: Sequence[PlannedRun]) -> None:
    """Print a table of the runs, and the number of runs in each state."""
    overrides = [item.shown for item in planned]
    shared = set.intersection(*map(set, overrides)) if len(planned) > 1 else set()
    states = [item.directory.state for item in planned]
    table = {
        "run": [item.directory.path.name for item in planned],
        "state": states,
        "steps": [item.run.trainer.max_steps for item in planned],
        "PSNR": [item.directory.metric for item in planned],
        "overrides": [" ".join(text for text in texts if text not in shared) for texts in overrides],
    }
    print(tabulate(table, "keys", floatfmt=".2f", disable_numparse=[0, 4]))
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(sorted(states)))
    print(f"{len(planned)} runs: {counts}", flush=True)


def print_plan(planned: Sequence[PlannedRun], directory: Path, rehearse: Rehearse) -> None:
    """Print runs with their states, where they write, and everything that is missing.

    Args:
        planned: All runs of a sweep, or a single run.
        directory: Directory of the sweep or of the run.
        rehearse: Checks the prerequisites of the unfinished runs.

    Raises:
        InputError: Something is missing.
    """
    reasons = rehearse([item for item in planned if not item.directory.done])
    print_states(planned)
    print(f"nothing was run; outputs below {directory}: {_OUTPUTS}")
    for reason in reasons:
        print(f"would be refused: {reason}", flush=True)
    if reasons:
        found = f"found {len(reasons)} missing, as said above"
        raise InputError(f"dry_run: expected runs that lack nothing; {found}")


def write_plan(planned: Sequence[PlannedRun], config: DictConfig, directory: Path) -> None:
    """Write each run's configuration, from which tables list planned runs.

    Args:
        planned: All runs of the sweep.
        config: Configuration of the command; saved in ``multirun.yaml``, which also lists the runs.
        directory: Directory of the sweep.
    """
    for item in planned:
        path = item.directory.path / "config.yaml"
        if not path.exists():
            write_text_atomically(path, saved_text(item.run.plain))
    names = dict.fromkeys([*(item.directory.path.name for item in planned), *runs_in_order(directory)])
    runs = OmegaConf.to_yaml({"runs": list(names)})
    write_text_atomically(directory / PLAN, OmegaConf.to_yaml(config) + runs)


def run_all(planned: Sequence[PlannedRun], launch: Launch) -> list[JobReturn]:
    """Launch runs until each has finished, in any process, or failed.

    A job that returns ``BUSY`` (its run is locked by another process) is launched again once that process
    has ended.

    Args:
        planned: All runs of the sweep; finished runs are not launched.
        launch: Starts jobs, given their overrides and the number of the first.

    Returns:
        The jobs' return values, in the order in which they ended.
    """
    todo = [item for item in planned if not item.directory.done]
    print(f"{len(planned)} runs: {len(planned) - len(todo)} done before, {len(todo)} to do", flush=True)
    returns: list[JobReturn] = []
    while todo:
        busy = []
        results = launch([item.overrides for item in todo], len(returns))
        for item, result in zip(todo, results, strict=True):
            if result.status == JobStatus.COMPLETED and result.return_value == BUSY:
                busy.append(item)
                continue
            returns.append(result)
            if result.status == JobStatus.FAILED:
                log.error("failed: %s: %s", item.directory.path, result._return_value)
        if todo := busy:
            print(f"waiting for {', '.join(item.directory.owner for item in todo)}", flush=True)
        while todo and all(item.directory.state == "running" for item in todo):
            time.sleep(_POLL)
    return returns


def _launch(launcher: Launcher, jobs: Sequence[Sequence[str]], first: int) -> Sequence[JobReturn]:
    """Launch jobs and wait for them; an error of the batch system becomes one line."""
    try:
        return launcher.launch(jobs, first)
    except RuntimeError as error:  # by submitit
        found = "; ".join(str(error).splitlines()[:2])
        raise InputError(f"hydra.launcher: expected jobs that end with a result; found {found}") from error
