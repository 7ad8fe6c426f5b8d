"""The planned runs of a sweep: states, expected training times and results, as printed."""

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tabulate import tabulate

from ghgs_lit.errors import InputError
from ghgs_lit.runs.progress import clock
from ghgs_lit.runs.run import RunDirectory, State

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Train
    from ghgs_lit.training.trainer import TrainerOptions

OUTPUTS = "config.yaml, checkpoints/, metrics.json, metrics.csv, sessions.jsonl, pictures and logs"


@dataclass(frozen=True)
class PlannedRun:
    """A run of a sweep.

    Attributes:
        name: hash of its configuration.
        overrides: of the job, with its directory.
        shown: overrides to print.
        run: its configuration.
        directory: of the run.
    """

    name: str
    overrides: tuple[str, ...]
    shown: tuple[str, ...]
    run: "Train"
    directory: RunDirectory


def time_budget(trainer: "TrainerOptions") -> float | None:
    """Seconds of ``trainer.max_time``.

    Args:
        trainer: Its options; the time is ``days:hours:minutes:seconds`` or a mapping.

    Returns:
        Seconds; None: no limit.
    """
    value = trainer.max_time
    if value is None:
        return None
    if isinstance(value, Mapping):
        return datetime.timedelta(**value).total_seconds()
    days, hours, minutes, seconds = map(int, value.split(":"))
    return datetime.timedelta(days, seconds, hours=hours, minutes=minutes).total_seconds()


def step_seconds(directory: Path) -> tuple[float, int] | None:
    """Mean time of a training step of the finished runs of a sweep.

    Args:
        directory: Of the sweep.

    Returns:
        Seconds of a step, and the number of runs; None: no run has finished.
    """
    steps = seconds = count = 0
    for path in sorted(directory.rglob("metrics.json")):
        sessions = [s for s in RunDirectory(path.parent).sessions() if s.get("steps")]
        steps += sum(s["steps"] for s in sessions)
        seconds += sum(s["seconds"] for s in sessions)
        count += bool(sessions)
    return (seconds / steps, count) if steps else None


def expected_seconds(trainer: "TrainerOptions", step: float | None) -> float | None:
    """Training time of a run by its budgets.

    Args:
        trainer: Its options.
        step: Measured seconds of a step; None: not measured.

    Returns:
        Seconds; None: not known.
    """
    steps = trainer.max_steps
    known = [time_budget(trainer), steps * step if steps > 0 and step is not None else None]
    return min((seconds for seconds in known if seconds is not None), default=None)


def shared_overrides(planned: Sequence[PlannedRun]) -> set[str]:
    """Overrides that all of several runs have."""
    return set.intersection(*(set(item.shown) for item in planned)) if len(planned) > 1 else set()


def _print_table(planned: Sequence[PlannedRun], columns: Mapping[str, Sequence[str]]) -> None:
    shared = shared_overrides(planned)
    overrides = []
    for item in planned:
        overrides.append(" ".join(o for o in item.shown if o not in shared))
    table = {"run": [item.name for item in planned], **columns, "overrides": overrides}
    print(tabulate(table, "keys", disable_numparse=True))


def _print_states(
    planned: Sequence[PlannedRun], columns: Mapping[str, Sequence[str]], end: str
) -> list[State]:
    states = [item.directory.state for item in planned]
    _print_table(planned, {"state": [s.value for s in states], **columns})
    counts = ", ".join(f"{states.count(state)} {state.value}" for state in State if state in states)
    print(f"{len(planned)} runs: {counts}{end}")
    return states


@dataclass(frozen=True)
class Rehearsal:
    """What a dry run has found.

    Attributes:
        reasons: why runs would be refused.
        notes: what else they should know.
    """

    reasons: Sequence[str] = ()
    notes: Sequence[str] = ()


#: Tries what configurations need.
Rehearse = Callable[[Sequence["Train"]], Rehearsal]


def print_plan(planned: Sequence[PlannedRun], directory: Path, rehearse: Rehearse) -> None:
    """Print the runs with their states, the training time of the remaining ones, the output paths
    and what is missing.

    Args:
        planned: All runs of the sweep.
        directory: Of the sweep.
        rehearse: Tries what the runs need that are not done.

    Raises:
        InputError: Something is missing.
    """
    rehearsal = rehearse([item.run for item in planned if not item.directory.done])
    measured = step_seconds(directory)
    step = measured[0] if measured else None
    trainers = [item.run.trainer for item in planned]
    times = [expected_seconds(trainer, step) for trainer in trainers]
    both = zip(trainers, times, strict=True)
    budgets = [f"{trainer.max_steps} steps" if time is None else clock(time) for trainer, time in both]
    states = _print_states(planned, {"trains for": budgets}, "; nothing was run")
    left = [t for t, state in zip(times, states, strict=True) if state != State.DONE]
    basis = ["trainer.max_time"] if any(time_budget(trainer) is not None for trainer in trainers) else []
    if measured:
        basis.append(f"{measured[0]:.3g} s a step, measured in {measured[1]} finished runs")
    known = "unknown" if None in left else clock(sum(left))
    reason = "; ".join(basis) or "no trainer.max_time, and no step was measured"
    print(f"expected training time of the remaining runs, one after another: {known} ({reason})")
    place = f"{directory}/<run>" if len(planned) > 1 else planned[0].directory.path
    print(f"outputs: {place}/ with {OUTPUTS}", flush=True)
    for note in rehearsal.notes:
        print(f"note: {note}")
    reasons = [*rehearsal.reasons, *_unreadable(planned, states)]
    for reason in reasons:
        print(f"would be refused: {reason}", flush=True)
    count = len(reasons)
    if count:
        raise InputError(f"dry_run: expected runs that lack nothing; found {count} missing, as said above")


def _unreadable(planned: Sequence[PlannedRun], states: Sequence[State]) -> list[str]:
    """What is wrong with checkpoints that runs would go on from, a line each."""
    from ghgs_lit.weights.checkpoint import read_checkpoint  # here: it imports PyTorch

    lines = []
    for item, state in zip(planned, states, strict=True):
        if state == State.PARTIAL and item.directory.checkpoint is not None:
            try:
                read_checkpoint(item.directory.checkpoint)
            except (InputError, OSError) as error:
                lines.append(f"{' '.join(str(error).split())} (without this file the run begins anew)")
    return lines


def print_results(planned: Sequence[PlannedRun], directory: Path) -> None:
    """Print the runs with their states and results, then the path of the sweep.

    Args:
        planned: All runs of the sweep.
        directory: Of the sweep.
    """
    shown = ["" if (m := item.directory.metric) is None else f"{m:.2f}" for item in planned]
    sessions = [str(len(item.directory.sessions())) for item in planned]
    _print_states(planned, {"PSNR": shown, "sessions": sessions}, "")
    print(f"wrote {directory}", flush=True)
