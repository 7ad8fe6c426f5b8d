"""Grid sweeper (``hydra/sweeper=grid``):
launches those runs of a grid that are not done."""

import contextlib
import json
import logging
import re
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus, filter_overrides
from omegaconf import DictConfig, OmegaConf, open_dict

from ghgs_lit.config.compose import check_ablation, chosen_options, plain, saved_text
from ghgs_lit.config.defaults import fill
from ghgs_lit.config.keys import is_hyperparameter, key_of
from ghgs_lit.config.registry import verb_class
from ghgs_lit.errors import InputError, require
from ghgs_lit.files import require_writable, resolved, write_text_atomically
from ghgs_lit.parsing import read_yaml
from ghgs_lit.runs.job import BUSY, check_config, check_launcher
from ghgs_lit.runs.planned import PlannedRun, Rehearse, print_plan, print_results, shared_overrides
from ghgs_lit.runs.processes import queue_again
from ghgs_lit.runs.provenance import config_hash, differences
from ghgs_lit.runs.run import PLAN, SWEPT, RunDirectory, State, runs_in_order
from ghgs_lit.runs.signals import Interrupted, interruptible, print_how_to_go_on, stop_if_interrupted
from ghgs_lit.runs.submission import submit


def _sets_apart(override: str, shared: set[str]) -> bool:
    key = key_of(override)
    return is_hyperparameter(key) and (key == "seed" or override not in shared)


log = logging.getLogger(__name__)
_POLL = 2.0  # seconds between checks of runs that other processes work on

Launch = Callable[[Sequence[Sequence[str]], int], Sequence[JobReturn]]


def sweep(sweeper: BasicSweeper, arguments: Sequence[str], rehearse: Rehearse) -> list[Sequence[JobReturn]]:
    """Run the grid of a command, or with ``dry_run`` print its plan.

    Args:
        sweeper: Hydra's, with configuration, launcher and parameters.
        arguments: Overrides of the command line.
        rehearse: Tries what runs need, for ``dry_run``.

    Returns:
        What the jobs returned, as Hydra asks for it.

    Raises:
        InputError: A configuration, a directory or the launcher is refused; with ``dry_run``
            something is missing.
        Interrupted: Ctrl-C or SIGTERM; no further run is started.
    """
    directory = resolved(str(sweeper.config.hydra.sweep.dir))
    begun: list[PlannedRun] = []
    try:
        with interruptible():
            planned = _planned(sweeper, arguments, directory)
            if differing := differing_from_others(planned, directory):
                print(differing, flush=True)
            if sweeper.config.get("dry_run"):
                print_plan(planned, directory, rehearse)
                return []
            begun = planned
            write_plan(planned, sweeper.config, directory)
            launch = partial(submit, sweeper.launcher, sweeper.config.hydra.launcher)
            returns = run_all(planned, launch, sweeper.max_batch_size)
    except Interrupted as stop:
        if not stop.explained:
            how = _how_to_go_on(begun, directory)
            print_how_to_go_on(stop, "the sweep", how, queue_again(stop.number))
        raise
    print_results(planned, directory)
    for result in returns:
        _ = result.return_value  # raises what the job raised
    return [returns]


def _how_to_go_on(begun: Sequence[PlannedRun], directory: Path) -> str:
    """What was run of a sweep that is interrupted, and which command goes on.

    Args:
        begun: All runs of the sweep; none: it was not begun.
        directory: Of the sweep.
    """
    if not begun:
        return "nothing was run; to begin, the same command"
    done = sum(item.directory.done for item in begun)
    return (
        f"{done} of {len(begun)} runs are done; to go on, the same command with hydra.sweep.dir={directory}"
    )


def _planned(sweeper: BasicSweeper, arguments: Sequence[str], directory: Path) -> list[PlannedRun]:
    """The runs of a sweep, which are checked as far as that takes no time. Nothing is written.

    Args:
        sweeper: Hydra's, with configuration, launcher and parameters.
        arguments: Overrides of the command line.
        directory: Of the sweep.

    Raises:
        InputError: As for :func:`sweep`.
    """
    config = sweeper.config
    batch = sweeper.max_batch_size
    require(batch is None or batch >= 1, "hydra.sweeper.max_batch_size", "a number of at least 1", batch)
    loader = sweeper.hydra_context.config_loader
    combos = combinations(sweeper.params, arguments, loader)
    verb = sweeper.verb
    planned = plan(combos, lambda overrides: loader.load_sweep_config(config, overrides), directory, verb)
    if len(planned) < len(combos):
        print(f"{len(combos)} combinations, {len(planned)} different configurations", flush=True)
    for item in planned:  # an impossible launcher is refused before anything starts
        check_launcher(item.run, config.hydra.runtime.choices["hydra/launcher"])
    check_directories(planned)
    if not all(item.directory.done for item in planned):
        require_writable(directory, "hydra.sweep.dir", "the runs")
    if config.get("dry_run"):
        return planned
    for item in planned:
        require(not item.run.overwrite, "overwrite", "false in a sweep, which goes on with its runs", True)
        check_config(item.run)
    return planned


def combinations(
    params: Mapping[str, Any] | None, arguments: Sequence[str], loader: ConfigLoader | None = None
) -> list[list[str]]:
    """Overrides of each job; values of the command line replace the sweep's own.

    Args:
        params: ``hydra.sweeper.params``: values of keys, separated by commas; None: none.
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


def plan(
    combos: Sequence[Sequence[str]],
    compose: Callable[[list[str]], DictConfig],
    directory: Path,
    verb: str = "train",
) -> list[PlannedRun]:
    """Distinct runs of the jobs of a sweep.

    Args:
        combos: Overrides of each job.
        compose: Makes the configuration of a job's overrides, with the node ``hydra``.
        directory: Of the sweep.
        verb: Name of a verb that trains as ``ghgs train`` does.

    Returns:
        Runs in the order of the jobs; jobs of one configuration are one run.

    Raises:
        InputError: A configuration is bad or lacks a value, or the verb does not train.
    """
    trains = issubclass(verb_class(verb), verb_class("train"))
    require(trains, "hydra/sweeper", f"basic for ghgs {verb}, which is not derived from ghgs train", "grid")
    planned: dict[str, PlannedRun] = {}
    for overrides in combos:
        stop_if_interrupted()
        cfg = compose(list(overrides))
        check_ablation(cfg, cfg.hydra)
        with open_dict(cfg):
            cfg.hydra.job.num = len(planned)
            subdirectory = str(cfg.hydra.sweep.subdir)
            hydra_node = cfg.hydra
            del cfg["hydra"]
        run = verb_class(verb).of(plain(fill(cfg)))
        run = run.replace(chosen=chosen_options(run.plain, hydra_node))
        name = config_hash(run.plain)
        shown = tuple(filter_overrides(overrides))
        # The job writes to the planned directory, whatever number a launcher gives it.
        places = {"dir": str(directory), "subdir": subdirectory}
        fixed = (f"hydra.sweep.{key}={_quoted(place)}" for key, place in places.items())
        place = RunDirectory(directory / subdirectory, name)
        planned.setdefault(name, PlannedRun(name, (*overrides, *fixed), shown, run, place))
    return list(planned.values())


def _quoted(text: str) -> str:
    """``text`` as a value of an override."""
    return "'" + re.sub(r"(\\*)('|$)", lambda match: 2 * match[1] + ("\\'" if match[2] else ""), text) + "'"


def check_directories(planned: Sequence[PlannedRun]) -> None:
    """Check that each run has a directory of its own.

    Args:
        planned: All runs of the sweep.

    Raises:
        InputError: Two share a directory, or it has another run.
    """
    runs = {}
    for item in planned:
        other = runs.setdefault(item.directory.path, item)
        shared = f"{item.directory.path} for {' '.join(other.shown)} and {' '.join(item.shown)}"
        require(other is item, "hydra.sweep.subdir", "a directory for each configuration", shared)
        if not item.directory.done:
            item.directory.start(item.run)


def differing_from_others(planned: Sequence[PlannedRun], directory: Path) -> str | None:
    """What tells the runs of a sweep, if none of them was begun, from others in its directory.

    Whoever means to go on with those has changed a key: nothing of theirs is used.

    Args:
        planned: All runs of the sweep.
        directory: Of the sweep.

    Returns:
        A line with the keys in which the closest of the others differs from the first run;
        None: a run was begun, or there are no others.
    """
    if any(item.directory.swept for item in planned):
        return None
    others = []
    for path in sorted(directory.glob(f"*/{SWEPT}")):
        with contextlib.suppress(InputError, OSError):  # a damaged one is not of this sweep
            others.append(differences(read_yaml(path.with_name("config.yaml")), planned[0].run.plain))
    keys = min(others, key=len, default=[])
    if not keys:
        return None
    shown = ", ".join(keys[:3]) + (f" and {len(keys) - 3} more" if len(keys) > 3 else "")
    return f"none of these runs was begun; {len(others)} others in {directory} differ: {shown}"


def write_plan(planned: Sequence[PlannedRun], config: DictConfig, directory: Path) -> None:
    """Write each run's configuration, by which tables recognise planned runs,
    and what sets it apart.

    Args:
        planned: All runs of the sweep.
        config: Configuration of the command, for ``multirun.yaml``, which also lists the runs.
        directory: Of the sweep.
    """
    titles = {RunDirectory(path.parent).title for path in directory.glob(f"*/{SWEPT}")}
    shared = shared_overrides(planned)
    for item in planned:
        path = item.directory.path / "config.yaml"
        if not path.exists():
            write_text_atomically(path, saved_text(item.run.plain))
        if not item.directory.swept:
            swept = [o for o in item.shown if _sets_apart(o, shared)]
            write_text_atomically(item.directory.path / SWEPT, json.dumps(swept or [f"run={item.name}"]))
            if item.directory.title in titles:  # of a grid with other settings in the same folder
                write_text_atomically(item.directory.path / SWEPT, json.dumps([*swept, f"run={item.name}"]))
            titles.add(item.directory.title)
    names = dict.fromkeys([*(item.directory.path.name for item in planned), *runs_in_order(directory)])
    runs = OmegaConf.to_yaml({"runs": list(names)})
    write_text_atomically(directory / PLAN, OmegaConf.to_yaml(config) + runs)


def run_all(planned: Sequence[PlannedRun], launch: Launch, batch: int | None = None) -> list[JobReturn]:
    """Launch runs until each one has finished, here or elsewhere, or failed.

    A job that returns ``BUSY`` (another process works on its run) is launched again once that
    process has ended.

    Args:
        planned: All runs of the sweep; those that are done are not launched.
        launch: Starts jobs, given their overrides and the number of the first.
        batch: Jobs at once, at least 1; None: all.

    Returns:
        What the jobs returned, in the order in which they ended.
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
                    shown = " ".join(item.shown)
                    log.error("failed: %s (%s): %s", item.directory.path, shown, _error(result))
                if result.status == JobStatus.COMPLETED and result.return_value == BUSY:
                    busy.append(item)
                else:
                    returns.append(result)
        if todo := busy:
            print(f"waiting for {', '.join(item.directory.owner for item in todo)}", flush=True)
        while todo and all(item.directory.state == State.RUNNING for item in todo):
            time.sleep(_POLL)
    return returns


def _error(result: JobReturn) -> str:
    try:
        return str(result.return_value)
    except Exception as error:
        return f"{type(error).__name__}: {error}".splitlines()[0]
