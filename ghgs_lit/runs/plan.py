"""Plan of a sweep: its runs with their states, what they require and their expected training time."""

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tabulate import tabulate

from ghgs_lit.errors import InputError
from ghgs_lit.runs.progress import format_duration
from ghgs_lit.runs.run import RunDirectory, State

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Train
    from ghgs_lit.training.trainer import TrainerOptions

OUTPUTS = "config.yaml, checkpoints/, metrics.json, metrics.csv, sessions.jsonl, pictures and logs"


@dataclass(frozen=True)
class PlannedRun:
    """One run of a sweep.

    Attributes:
        name: Hash of its configuration.
        overrides: Hydra overrides of the job, including those that set its directory.
        shown: Overrides to print.
        run: Configuration of the run.
        directory: Directory of the run.
    """

    name: str
    overrides: tuple[str, ...]
    shown: tuple[str, ...]
    run: "Train"
    directory: RunDirectory


@dataclass(frozen=True)
class Rehearsal:
    """Result of the checks of a dry run.

    Attributes:
        reasons: Why runs would be rejected, one line each.
        notes: Further information for the user, one line each.
    """

    reasons: Sequence[str] = ()
    notes: Sequence[str] = ()


Rehearse = Callable[[Sequence["Train"]], Rehearsal]


def shared_overrides(planned: Sequence[PlannedRun]) -> set[str]:
    return set.intersection(*(set(item.shown) for item in planned)) if len(planned) > 1 else set()


def step_seconds(directory: Path) -> tuple[float, int] | None:
    """Mean seconds per training step over the finished runs of a sweep, and the number of these runs;
    None if no run has finished."""
    steps = seconds = count = 0
    for path in directory.rglob("metrics.json"):
        sessions = [s for s in RunDirectory(path.parent).sessions() if s.get("steps")]
        steps += sum(s["steps"] for s in sessions)
        seconds += sum(s["seconds"] for s in sessions)
        count += bool(sessions)
    return (seconds / steps, count) if steps else None


def time_budget(trainer: "TrainerOptions") -> float | None:
    """Seconds of ``trainer.max_time`` (``days:hours:minutes:seconds`` or a mapping); None: no limit."""
    value = trainer.max_time
    if isinstance(value, str):
        value = dict(zip(("days", "hours", "minutes", "seconds"), map(int, value.split(":")), strict=True))
    return None if value is None else datetime.timedelta(**value).total_seconds()


def print_states(
    planned: Sequence[PlannedRun], columns: Mapping[str, Sequence[str]], end: str = ""
) -> list[State]:
    """Print a table of the runs, with further ``columns``, and the number of runs in each state."""
    shared = shared_overrides(planned)
    states = [item.directory.state for item in planned]
    overrides = [" ".join(o for o in item.shown if o not in shared) for item in planned]
    table = {"run": [item.name for item in planned], "state": [s.value for s in states], **columns}
    print(tabulate(table | {"overrides": overrides}, "keys", disable_numparse=True))
    counts = ", ".join(f"{states.count(state)} {state.value}" for state in State if state in states)
    print(f"{len(planned)} runs: {counts}{end}")
    return states


def print_plan(planned: Sequence[PlannedRun], directory: Path, rehearse: Rehearse) -> None:
    """Print the runs with their states, the expected training time of the remaining ones, the output
    paths and everything that is missing.

    Args:
        planned: All runs of the sweep.
        directory: Directory of the sweep.
        rehearse: Checks the prerequisites of the unfinished runs.

    Raises:
        InputError: Something is missing.
    """
    rehearsal = rehearse([item.run for item in planned if not item.directory.done])
    measured = step_seconds(directory)
    budgets, remaining, is_limited = [], [], False
    for trainer, is_done in ((item.run.trainer, item.directory.done) for item in planned):
        limit = time_budget(trainer)
        is_limited |= limit is not None
        times = [] if limit is None else [limit]
        if measured and trainer.max_steps > 0:
            times.append(trainer.max_steps * measured[0])
        expected = min(times, default=None)
        budgets.append(f"{trainer.max_steps} steps" if expected is None else format_duration(expected))
        if not is_done:
            remaining.append(expected)
    states = print_states(planned, {"trains for": budgets}, "; nothing was run")
    basis = ["trainer.max_time"] if is_limited else []
    if measured:
        basis.append(f"{measured[0]:.3g} s a step, measured in {measured[1]} finished runs")
    total = "unknown" if None in remaining else format_duration(sum(remaining))
    reason = "; ".join(basis) or "no trainer.max_time, and no step was measured"
    print(f"expected training time of the remaining runs, one after another: {total} ({reason})")
    place = f"{directory}/<run>" if len(planned) > 1 else planned[0].directory.path
    print(f"outputs: {place}/ with {OUTPUTS}", flush=True)
    for note in rehearsal.notes:
        print(f"note: {note}")
    reasons = [*rehearsal.reasons, *_find_unreadable(planned, states)]
    for reason in reasons:
        print(f"would be refused: {reason}", flush=True)
    count = len(reasons)
    if count:
        raise InputError(f"dry_run: expected runs that lack nothing; found {count} missing, as said above")


def _find_unreadable(planned: Sequence[PlannedRun], states: Sequence[State]) -> list[str]:
    """One line for each checkpoint that a run would resume from but that cannot be read."""
    from ghgs_lit.weights.checkpoint import read_checkpoint  # here: it imports PyTorch

    lines = []
    for item, state in zip(planned, states, strict=True):
        if state == State.PARTIAL:
            try:
                read_checkpoint(item.directory.checkpoint)
            except (InputError, OSError) as error:
                lines.append(f"{' '.join(str(error).split())} (without this file the run begins anew)")
    return lines
