"""The sweeper of ``conf/hydra/sweeper/grid.yaml``: launches the runs of a grid that are not done."""

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus, filter_overrides
from omegaconf import DictConfig, OmegaConf, open_dict

from ghgs_lit.cli.runtime import announce, plain
from ghgs_lit.errors import InputError
from ghgs_lit.runs.job import BUSY, refuse_shared_process
from ghgs_lit.runs.plan import Planned, print_plan, print_results
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.runs.run import Run, State

log = logging.getLogger(__name__)
_POLL = 2.0  # seconds between two looks at runs that others work on

Launch = Callable[[Sequence[Sequence[str]], int], Sequence[JobReturn]]


def sweep(sweeper: BasicSweeper, arguments: Sequence[str]) -> list[Sequence[JobReturn]]:
    """Carry out, or only print (``dry_run``), the grid of ``arguments`` over the sweeper's parameters."""
    config, loader = sweeper.config, sweeper.hydra_context.config_loader
    directory = Path(str(config.hydra.sweep.dir)).resolve()
    planned = plan(
        combinations(sweeper.params, arguments),
        lambda overrides: loader.load_sweep_config(config, overrides),
    )
    for item in planned:
        refuse_shared_process(item.config, config.hydra.runtime.choices["hydra/launcher"])
    if config.get("dry_run"):
        print_plan(planned, directory)
        return []
    remember(planned, config, directory)
    returns = carry_out(planned, sweeper.launcher.launch, sweeper.max_batch_size)
    print_results(planned, directory)
    announce(directory)
    for result in returns:
        _ = result.return_value  # raises what the job raised
    return [returns]


def combinations(params: Mapping[str, Any] | None, arguments: Sequence[str]) -> list[list[str]]:
    """Overrides of each job; what the command line says of a key replaces the sweep's own values."""
    parser = OverridesParser.create()
    given = parser.parse_overrides(list(arguments))
    keys = {override.get_key_element() for override in given}
    own = parser.parse_overrides([f"{k}={v}" for k, v in (params or {}).items() if k not in keys])
    (batch,) = BasicSweeper.split_arguments([*own, *given], None)
    return batch


def plan(combos: Sequence[Sequence[str]], compose: Callable[[list[str]], DictConfig]) -> list[Planned]:
    """The different runs among ``combos``, in order.

    Raises:
        InputError: a job's configuration is bad or lacks a value.
    """
    planned: dict[str, Planned] = {}
    for overrides in combos:
        cfg = compose(list(overrides))
        directory = Path(str(cfg.hydra.sweep.dir))
        with open_dict(cfg):
            del cfg["hydra"]
        config = plain(cfg)
        name = config_hash(config)
        shown = tuple(filter_overrides(overrides))
        planned.setdefault(name, Planned(name, tuple(overrides), shown, config, Run(directory / name)))
    return list(planned.values())


def remember(planned: Sequence[Planned], config: DictConfig, directory: Path) -> None:
    """Write down what is planned: tables show runs that have a configuration and no results as missing."""
    for item in planned:
        path = item.run.directory / "config.yaml"
        if not path.exists():
            _write(path, OmegaConf.to_yaml(OmegaConf.create(item.config)))
    _write(directory / "multirun.yaml", OmegaConf.to_yaml(config))


def _write(path: Path, text: str) -> None:
    """Written aside and renamed: two processes may work on one sweep."""
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    aside.write_text(text)
    aside.replace(path)


def carry_out(planned: Sequence[Planned], launch: Launch, batch: int | None = None) -> list[JobReturn]:
    """Launch what is not done until everything is done here or elsewhere, or has failed.

    A job whose run another process has taken comes back ``BUSY``: it is launched again once that process
    has finished or died.
    """
    before = len(planned)
    todo = [item for item in planned if not item.run.done]
    print(f"{before} runs: {before - len(todo)} done before, {len(todo)} to do", flush=True)
    returns: list[JobReturn] = []
    while todo:
        left = []
        for jobs in _batches(todo, batch):
            results = launch([item.overrides for item in jobs], len(returns))
            for item, result in zip(jobs, results, strict=True):
                if result.status == JobStatus.FAILED:
                    log.error("failed: %s (%s): %s", item.run.directory, " ".join(item.shown), _error(result))
                if result.status == JobStatus.COMPLETED and result.return_value == BUSY:
                    left.append(item)
                else:
                    returns.append(result)
        todo = left
        _wait_for_one(todo)
    return returns


def _batches(items: list[Planned], size: int | None) -> Iterator[list[Planned]]:
    if size is not None and size < 1:
        raise InputError(f"hydra.sweeper.max_batch_size: expected a number of at least 1; found {size}")
    size = size or len(items)
    for first in range(0, len(items), size):
        yield items[first : first + size]


def _wait_for_one(items: Sequence[Planned]) -> None:
    """Return when one of the runs is no longer worked on."""
    if not items:
        return
    print(f"waiting for {', '.join(item.run.owner for item in items)}", flush=True)
    while all(item.run.state == State.RUNNING for item in items):
        time.sleep(_POLL)


def _error(result: JobReturn) -> str:
    try:
        return str(result.return_value)
    except Exception as error:
        return f"{type(error).__name__}: {error}".splitlines()[0]
