"""The sweeper of ``conf/hydra/sweeper/grid.yaml``: launches the runs of a grid that are not done."""

import itertools
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.utils import JobReturn, JobStatus, filter_overrides
from omegaconf import DictConfig, OmegaConf, open_dict

from ghgs_lit.config import resolve
from ghgs_lit.config.compose import saved_text
from ghgs_lit.config.verbs import VERBS
from ghgs_lit.errors import require
from ghgs_lit.files import write_text_atomically
from ghgs_lit.runs.job import BUSY, check_config, trains_in_several_processes
from ghgs_lit.runs.plan import PlannedRun, print_plan, print_results
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.runs.run import RunDirectory, State
from ghgs_lit.runs.signals import Interrupted, interruptible, print_how_to_go_on

log = logging.getLogger(__name__)
_POLL = 2.0  # seconds between two looks at runs that other processes work on
_MOST_RUNS = 10_000  # of a sweep

Launch = Callable[[Sequence[Sequence[str]], int], Sequence[JobReturn]]


def sweep(sweeper: BasicSweeper, arguments: Sequence[str]) -> list[Sequence[JobReturn]]:
    """Run, or with ``dry_run`` only print, the grid of ``arguments`` and the sweeper's parameters.
    Interrupted: on Ctrl-C and SIGTERM; no further run is started."""
    directory = Path(str(sweeper.config.hydra.sweep.dir)).resolve()
    with interruptible():
        try:
            return _sweep(sweeper, arguments, directory)
        except Interrupted as stop:
            if not stop.explained:
                print_how_to_go_on(stop, "the sweep", f"hydra.sweep.dir={directory}")
            raise


def _sweep(sweeper: BasicSweeper, arguments: Sequence[str], directory: Path) -> list[Sequence[JobReturn]]:
    config, loader = sweeper.config, sweeper.hydra_context.config_loader
    planned = plan(
        combinations(sweeper.params, arguments, loader),
        lambda overrides: loader.load_sweep_config(config, overrides),
    )
    for item in planned:  # an impossible launcher is refused before anything starts
        trains_in_several_processes(item.config, config.hydra.runtime.choices["hydra/launcher"])
    if config.get("dry_run"):
        print_plan(planned, directory)
        return []
    require(not config.get("overwrite"), "overwrite", "false in a sweep, which goes on with its runs", True)
    for item in planned:
        check_config(item.config)
    write_plan(planned, config, directory)
    returns = run_all(planned, sweeper.launcher.launch, sweeper.max_batch_size)
    print_results(planned, directory)
    for result in returns:
        _ = result.return_value  # raises what the job raised
    return [returns]


def combinations(
    params: Mapping[str, Any] | None, arguments: Sequence[str], loader: ConfigLoader | None = None
) -> list[list[str]]:
    """The overrides of each job; the command line's values of a key replace the sweep's own. ``loader`` knows
    the options of groups, which ``glob(*)`` stands for."""
    parser = OverridesParser.create(config_loader=loader)
    given = parser.parse_overrides(list(arguments))
    keys = {override.get_key_element() for override in given}
    own = parser.parse_overrides([f"{k}={v}" for k, v in (params or {}).items() if k not in keys])
    _require_few([*own, *given])
    (batch,) = BasicSweeper.split_arguments([*own, *given], None)
    return batch


def _require_few(overrides: Sequence[Override]) -> None:
    """Refuse a grid that would take all memory before any of its runs starts."""
    count = 1
    for override in overrides:
        if override.is_sweep_override() and override.is_discrete_sweep():
            # Not the iterator of a range, which would list it to shuffle it.
            values = override.value().range() if override.is_range_sweep() else override.sweep_iterator()
            count *= sum(1 for _ in itertools.islice(values, _MOST_RUNS + 1))
            require(count <= _MOST_RUNS, override.key_or_group, f"at most {_MOST_RUNS} runs", "more")


def plan(combos: Sequence[Sequence[str]], compose: Callable[[list[str]], DictConfig]) -> list[PlannedRun]:
    """The different runs among the jobs, in order; ``compose`` makes a configuration of a job's overrides.
    InputError: a job's configuration is bad or lacks a value."""
    planned: dict[str, PlannedRun] = {}
    for overrides in combos:
        cfg = compose(list(overrides))
        directory, verb = Path(str(cfg.hydra.sweep.dir)), cfg.hydra.job.name
        with open_dict(cfg):
            del cfg["hydra"]
        config = resolve(cfg, verb if verb in VERBS else None)
        name = config_hash(config)
        shown = tuple(filter_overrides(overrides))
        run = RunDirectory(directory / name)
        planned.setdefault(name, PlannedRun(name, tuple(overrides), shown, config, run))
    return list(planned.values())


def write_plan(planned: Sequence[PlannedRun], config: DictConfig, directory: Path) -> None:
    """Write each run's configuration, by which tables know that it is planned."""
    for item in planned:
        path = item.run.path / "config.yaml"
        if not path.exists():
            write_text_atomically(path, saved_text(item.config))
    write_text_atomically(directory / "multirun.yaml", OmegaConf.to_yaml(config))


def run_all(planned: Sequence[PlannedRun], launch: Launch, batch: int | None = None) -> list[JobReturn]:
    """Launch runs until each one is done, here or elsewhere, or has failed. A job whose run another process
    works on returns ``BUSY``: it is launched again once that process has finished or died. ``launch`` starts
    jobs, given their overrides and the number of the first; ``batch`` of them at once, None: all."""
    todo = [item for item in planned if not item.run.done]
    print(f"{len(planned)} runs: {len(planned) - len(todo)} done before, {len(todo)} to do", flush=True)
    returns: list[JobReturn] = []
    require(batch is None or batch >= 1, "hydra.sweeper.max_batch_size", "a number of at least 1", batch)
    while todo:
        busy, size = [], batch or len(todo)
        for jobs in (todo[first : first + size] for first in range(0, len(todo), size)):
            results = launch([item.overrides for item in jobs], len(returns))
            for item, result in zip(jobs, results, strict=True):
                if result.status == JobStatus.FAILED:
                    log.error("failed: %s (%s): %s", item.run.path, " ".join(item.shown), _error(result))
                if result.status == JobStatus.COMPLETED and result.return_value == BUSY:
                    busy.append(item)
                else:
                    returns.append(result)
        if todo := busy:
            print(f"waiting for {', '.join(item.run.owner for item in todo)}", flush=True)
        while todo and all(item.run.state == State.RUNNING for item in todo):
            time.sleep(_POLL)
    return returns


def _error(result: JobReturn) -> str:
    try:
        return str(result.return_value)
    except Exception as error:
        return f"{type(error).__name__}: {error}".splitlines()[0]
