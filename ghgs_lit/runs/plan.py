"""What a sweep will run, and what it has run, as tables on the terminal."""

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tabulate import tabulate

from ghgs_lit.errors import InputError
from ghgs_lit.runs.job import check_config, is_multirun
from ghgs_lit.runs.progress import clock
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.runs.run import RunDirectory, State

OUTPUTS = "config.yaml, checkpoints/, metrics.json, metrics.csv, sessions.jsonl, pictures and logs"


@dataclass(frozen=True)
class PlannedRun:
    """A run of a sweep: the hash of its configuration, all of its overrides, and those to print."""

    name: str
    overrides: tuple[str, ...]
    shown: tuple[str, ...]
    config: Mapping[str, Any]
    run: RunDirectory


def time_budget(config: Mapping[str, Any]) -> float | None:
    """Seconds of ``trainer.max_time`` (``days:hours:minutes:seconds`` or a mapping); None without one."""
    value = config["trainer"].get("max_time")
    if value is None:
        return None
    if isinstance(value, Mapping):
        return datetime.timedelta(**value).total_seconds()
    days, hours, minutes, seconds = map(int, value.split(":"))
    return datetime.timedelta(days, seconds, hours=hours, minutes=minutes).total_seconds()


def step_seconds(directory: Path) -> tuple[float, int] | None:
    """Mean seconds of a training step in the runs below ``directory`` that are done, and their number."""
    steps = seconds = count = 0
    for path in sorted(directory.glob("*/metrics.json")):
        sessions = [s for s in RunDirectory(path.parent).sessions() if s.get("steps")]
        steps += sum(s["steps"] for s in sessions)
        seconds += sum(s["seconds"] for s in sessions)
        count += bool(sessions)
    return (seconds / steps, count) if steps else None


def expected_seconds(config: Mapping[str, Any], step: float | None) -> float | None:
    """How long a run trains, from its budgets and the measured seconds of a ``step``; None if unknown."""
    steps = config["trainer"].get("max_steps", -1)
    known = [time_budget(config), steps * step if steps > 0 and step is not None else None]
    return min((seconds for seconds in known if seconds is not None), default=None)


def _budget(config: Mapping[str, Any], seconds: float | None) -> str:
    return f"{config['trainer'].get('max_steps')} steps" if seconds is None else clock(seconds)


def _print_table(planned: Sequence[PlannedRun], columns: Mapping[str, Sequence[str]]) -> None:
    """Print one line for each run; overrides that all runs share are left out."""
    shared = set.intersection(*(set(item.shown) for item in planned)) if len(planned) > 1 else set()
    names = [item.name for item in planned]
    overrides = [" ".join(o for o in item.shown if o not in shared) for item in planned]
    table = {"run": names, **columns, "overrides": overrides}
    print(tabulate(table, "keys", disable_numparse=True))


def _counts(states: Sequence[State]) -> str:
    return ", ".join(f"{states.count(state)} {state.value}" for state in State if state in states)


def print_plan(planned: Sequence[PlannedRun], directory: Path) -> None:
    """Print the runs with their states, how long the remaining ones train, and where results go."""
    states = [item.run.state for item in planned]
    measured = step_seconds(directory)
    times = [expected_seconds(item.config, measured and measured[0]) for item in planned]
    budgets = [_budget(item.config, seconds) for item, seconds in zip(planned, times, strict=True)]
    _print_table(planned, {"state": [s.value for s in states], "trains for": budgets})
    print(f"{len(planned)} runs: {_counts(states)}; nothing was run")
    left = [t for t, state in zip(times, states, strict=True) if state != State.DONE]
    basis = ["trainer.max_time"] if any(time_budget(item.config) is not None for item in planned) else []
    if measured:
        basis.append(f"{measured[0]:.3g} s a step, measured in {measured[1]} finished runs")
    known = "unknown" if None in left else clock(sum(left))
    reason = "; ".join(basis) or "no trainer.max_time, and no finished run to measure a step in"
    print(f"expected training time of the remaining runs, one after another: {known} ({reason})")
    print(f"outputs: {directory}/<run>/ with {OUTPUTS}", flush=True)
    print_refusals([item.config for item in planned])


def print_refusals(configs: Sequence[Mapping[str, Any]]) -> None:
    """Print why runs would be refused as they are configured, each reason once."""
    reasons = {}
    for config in configs:
        try:
            check_config(config)
        except InputError as error:
            reasons[str(error)] = None
    for reason in reasons:
        print(f"would be refused: {reason}", flush=True)


def print_results(planned: Sequence[PlannedRun], directory: Path) -> None:
    """Print the runs with their states and results, and last the path of the sweep."""
    states = [item.run.state for item in planned]
    metrics = [item.run.metric for item in planned]
    shown = ["" if m is None else f"{m:.2f}" for m in metrics]
    sessions = [str(len(item.run.sessions())) for item in planned]
    _print_table(planned, {"state": [s.value for s in states], "PSNR": shown, "sessions": sessions})
    print(f"{len(planned)} runs: {_counts(states)}")
    print(f"wrote {directory}", flush=True)


def print_single_plan(config: Mapping[str, Any], run: RunDirectory) -> None:
    """Print the plan of one training run; refused in a sweep whose runs are not known in advance."""
    if is_multirun():
        # Any other error would count as one failed job, and the sweep would continue.
        raise SystemExit(
            "dry_run: expected hydra/sweeper=grid, which knows its runs in advance; found another"
        )
    budget = _budget(config, expected_seconds(config, None))
    _print_table([PlannedRun(config_hash(config), (), (), config, run)], {"trains for": [budget]})
    print(f"nothing was run; outputs: {run.path}/ with {OUTPUTS}", flush=True)
    print_refusals([config])
