"""What ``dry_run`` tries of the runs of a sweep: everything that they need,
and the time of one step."""

import logging
import re
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lightning.pytorch.callbacks import Callback

from ghgs_lit.cli.inputs import build_data, build_renderer, check_size, overrides
from ghgs_lit.cli.runtime import output_dir
from ghgs_lit.cli.train import build_trainer, quiet
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.protocols import check_evaluation
from ghgs_lit.execution.predictor import Predictor
from ghgs_lit.method.model import GHGS
from ghgs_lit.runs import job
from ghgs_lit.runs.planned import PlannedRun, Rehearsal, print_plan
from ghgs_lit.runs.provenance import config_hash
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.training import GHGSModule, start
from ghgs_lit.weights.checkpoint import read_checkpoint

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Train
    from ghgs_lit.data.datamodule import PhotographsDataModule
    from ghgs_lit.data.reader import Reader

_STEPS = 3  #: Steps that are taken for the time of the last one


class _Clock(Callback):
    """Seconds of the last step, waiting for its batch included."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._since = 0.0

    def on_train_batch_end(self, *_: Any) -> None:
        now = time.perf_counter()
        self.seconds = now - self._since
        self._since = now


class _Rehearsed:
    """What one run needs.

    Args:
        run: as configured.
        reasons: why runs would be refused, as keys in order of appearance.
        notes: what else they should know, likewise.
        listed: data and phases whose files were looked for, which several configurations share,
            and whether they are complete.
    """

    def __init__(
        self,
        run: "Train",
        reasons: dict[str, None],
        notes: dict[str, None],
        listed: dict[str, bool],
    ) -> None:
        self.run = run
        self.reasons = reasons
        self.notes = notes
        self.listed = listed

    def attempt(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        """The result of a call; None where it refuses its input, which is noted.

        Args:
            function: raises InputError or OSError where it refuses.
            *arguments: of the call.
            **named: of the call.
        """
        try:
            return function(*arguments, **named)
        except (InputError, OSError) as error:
            self.reasons[" ".join(str(error).split())] = None
            return None

    def check(self, folder: Path) -> "PhotographsDataModule | None":
        """Check everything but the step.

        Args:
            folder: for files of loggers.

        Returns:
            The data, if it can be trained on.
        """
        run = self.run
        self.attempt(job.check_config, run)
        model = self.attempt(GHGS.from_config, run.plain, empty=True)
        if model is not None and run.init_from is not None:
            options = run.init_strict, run.allow_random_encoder
            lines = self.attempt(start.initialize, model, run.init_from, *options) or ()
            if unfit := sum(line.startswith("wrong shape") for line in lines):
                left = f"{unfit} of {len(lines)} tensors have another shape in {run.init_from}"
                self.notes[f"init_from: {left}, and stay as initialised"] = None
        if run.resume not in (None, "auto"):
            self.attempt(read_checkpoint, run.resume)
        trainer = self.attempt(build_trainer, run, folder)
        if trainer is not None:
            self.attempt(build_renderer, run, trainer.strategy.root_device)
        for options in (run.loss, run.optimizer):
            self.attempt(options.build)
        metrics = self.attempt(run.metrics.build)
        for name, reason in getattr(metrics, "left_out", {}).items():
            self.notes[f"{name} will be left out: {reason}"] = None
        data = self.attempt(build_data, run)
        return data if data is not None and self._check_data(data, model) else None

    def _check_data(self, data: "PhotographsDataModule", model: GHGS | None) -> bool:
        """Note what is missing of the data.

        Args:
            data: as configured.
            model: whose patches photographs must fit; None: it was refused.

        Returns:
            Whether a step can be trained on it now: nothing is missing,
            and nothing must be rendered.
        """
        if model is not None:
            self.attempt(check_size, data, Predictor(model))
        split = self.run.evaluation.split
        if hasattr(data.dataset, "cache_dir") and not _is_rendered(data, {"train", "val", split}):
            self.notes[f"data={data.dataset.name}: people are rendered before the first step"] = None
            return False
        before = len(self.reasons)
        phases = [name for name in dict.fromkeys(("train", split)) if name in data.dataset.split_names]
        are_there = [self.attempt(self._check_files, data, phase) for phase in phases]
        if all(are_there):  # now what is in the files
            batch = self.attempt(data.training_batch, 0)
            self.attempt(check_evaluation, self.run, data)
            if self._chamfer and batch is not None and batch.body_vertices is None:
                self.reasons[self._lacks_body(data.builder("train").inputs.reader, batch.subjects[0])] = None
        if model is not None and self.run.feature_cache is not None:
            needed = self.attempt(self.run.feature_cache.needs, model, data)
            if needed is not None:
                self.notes[needed] = None
        return all(are_there) and len(self.reasons) == before

    @property
    def _chamfer(self) -> float | None:
        """Weight of the loss that needs bodies; None or 0: none are needed."""
        weights = getattr(self.run.loss, "weights", None)  # a plug-in's may have none
        return getattr(weights, "chamfer", None)

    def _lacks_body(self, reader: "Reader", name: str) -> str:
        """What says that a subject of the training has no body, which the loss needs."""
        expected = f"body vertices for loss.weights.chamfer={self._chamfer} (0 does without)"
        return f"{reader.body_place(name)}: expected {expected}; found none"

    def _check_files(self, data: "PhotographsDataModule", phase: str) -> bool:
        """Note what a phase lacks, one line for files that differ in numbers alone:
        what the reader says, files that are not there, bodies that the loss needs.

        Args:
            data: as configured.
            phase: name of a split.

        Returns:
            Whether nothing is missing; of data that were looked at before, as it was then.
        """
        key = f"{config_hash(self.run.plain['data'], without=())} {phase}"
        if key in self.listed:
            return self.listed[key]
        self.listed[key] = False
        reader = data.dataset.reader(phase, strict=False)

        def files_of(name: str) -> list[Path]:
            return list(reader.files(name))

        known = len(self.reasons)
        lines = list(reader.problems)
        needs_bodies = phase == "train" and self._chamfer
        for name in reader.subjects:
            body = reader.body_place(name)
            lacks_body = needs_bodies and isinstance(body, Path) and not body.exists()
            for path in self.attempt(files_of, name) or ():
                if not path.exists() and not (lacks_body and path == body):
                    lines.append(f"{path}: expected a file of the data set; found none")
            if lacks_body:
                lines.append(self._lacks_body(reader, name))
        self.reasons |= dict.fromkeys(summarized(lines))
        self.listed[key] = not lines and len(self.reasons) == known
        return self.listed[key]

    def step_seconds(self, data: "PhotographsDataModule", folder: Path) -> float | None:
        """Time of a training step of one process, which reads its own photographs.

        Args:
            data: complete.
            folder: for files of the Trainer.

        Returns:
            Seconds; None: the training refuses its input, which is noted.
        """
        run = self.run
        clock = _Clock()
        few = {"max_steps": _STEPS, "max_time": None, "limit_val_batches": 0, "devices": 1, "num_nodes": 1}
        trainer = {**few, "strategy": "auto", "profiler": None}
        quick = run.changed(trainer=trainer).replace(logger={}, callbacks={})
        model = GHGS.from_config(run.plain)
        parts = (options.build() for options in (run.renderer, run.loss, run.optimizer))
        module = GHGSModule(model, *parts, quick.plain, run.token_budgets)
        self.attempt(build_trainer(quick, folder, clock).fit, module, data)
        return clock.seconds or None


def summarized(lines: Iterable[str]) -> list[str]:
    """The first of lines that differ in numbers alone, with how many more there are.

    Args:
        lines: such as ``img/0001.png: expected a file; found none``.
    """
    alike: dict[str, list[str]] = {}
    for line in lines:
        alike.setdefault(re.sub(r"\d+", "#", line), []).append(line)
    return [
        first if not others else f"{first} (and {len(others)} more like it)"
        for first, *others in alike.values()
    ]


@contextmanager
def _warnings_as(notes: dict[str, None]) -> Iterator[None]:
    """Add what readers log to notes; it would stand between the lines of the plan.

    Args:
        notes: get the warnings of the block, as keys.
    """
    heard: list[str] = []
    handler = logging.Handler(logging.WARNING)
    handler.emit = lambda record: heard.append(record.getMessage())
    logger = logging.getLogger("ghgs_lit.data")
    logger.addHandler(handler)
    logger.propagate = False
    try:
        yield
    finally:
        logger.propagate = True
        logger.removeHandler(handler)
        notes |= dict.fromkeys(summarized(dict.fromkeys(heard)))


def _is_rendered(data: "PhotographsDataModule", splits: Iterable[str]) -> bool:
    """Whether all these splits have subjects that can be read."""
    try:
        return all(bool(data.subjects(split)) for split in splits)
    except (InputError, OSError):
        return False


def rehearse(runs: Sequence["Train"]) -> Rehearsal:
    """Try what runs need, each different need once, and time a step of the first run.

    Nothing is rendered or written; no step is taken if something is missing.

    Args:
        runs: as configured.

    Returns:
        Reasons, notes and the seconds of a step.
    """
    reasons: dict[str, None] = {}
    notes: dict[str, None] = {}
    listed: dict[str, bool] = {}
    tried = set()
    seconds = None
    quiet()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings(), _warnings_as(notes):
        warnings.simplefilter("ignore")
        for given in runs:
            run = given.changed(data={"workers": 0})
            key = config_hash({**run.plain, "seed": 0})
            if key in tried:
                continue
            rehearsed = _Rehearsed(run, reasons, notes, listed)
            data = rehearsed.check(Path(folder))
            if not tried and data is not None and not reasons:
                seconds = rehearsed.step_seconds(data, Path(folder))
            tried.add(key)
    return Rehearsal(summarized(reasons), list(notes), seconds)


def plan(run: "Train") -> None:
    """Print the plan of a single run, as of :func:`ghgs_lit.runs.planned.print_plan`.

    Args:
        run: as configured.

    Raises:
        InputError: something is missing.
    """
    directory = RunDirectory(output_dir()).of(run)
    item = PlannedRun(directory.path.name, (), tuple(overrides()), run, directory)
    print_plan([item], directory.path, rehearse)
