"""Checks of ``dry_run``: everything that runs require before their first step."""

import re
import tempfile
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from ghgs_lit.cli.inputs import build_data, build_renderer, check_size, overrides
from ghgs_lit.cli.runtime import output_dir
from ghgs_lit.cli.train import build_trainer, silence_lightning
from ghgs_lit.config.run import Run
from ghgs_lit.data.datamodule import PhotographsDataModule
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.report import check_evaluation
from ghgs_lit.execution.predictor import Predictor
from ghgs_lit.method.model import GHGS
from ghgs_lit.runs import job
from ghgs_lit.runs.results import config_hash
from ghgs_lit.runs.run import AUTO, RunDirectory
from ghgs_lit.runs.sweep import PlannedRun, print_plan
from ghgs_lit.training import start
from ghgs_lit.weights.checkpoint import read_checkpoint

#: Nodes of a configuration that determine which files a run reads.
_OF_DATA = ("data", "views", "targets", "evaluation", "augmentation", "loss")


def rehearse(planned: Sequence[PlannedRun]) -> list[str]:
    """Check the prerequisites of runs, each configuration once; renders and writes nothing and takes no
    step.

    Returns:
        One line for everything that is missing.
    """
    reasons = _Reasons()
    runs = {config_hash({**item.run.plain, "seed": 0}): item.run for item in planned}
    silence_lightning()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for item in planned:
            if item.directory.checkpoint is not None:
                reasons.attempt(read_checkpoint, item.directory.checkpoint)
        of_data = {}
        for run in runs.values():
            data = _build_all(run, Path(folder), reasons)
            if data is not None:
                of_data[config_hash({name: run.plain.get(name) for name in _OF_DATA})] = run, data
        for run, data in of_data.values():
            _read_data(run, data, reasons)
    return _summarize(reasons)


class _Reasons(list[str]):
    """One line for each thing that is missing."""

    def attempt(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        """Result of a call; None if it raises an input error, which becomes a reason."""
        try:
            return function(*arguments, **named)
        except (InputError, OSError) as error:
            self.append(" ".join(str(error).split()))
            return None


def _build_all(run: Run, folder: Path, reasons: _Reasons) -> PhotographsDataModule | None:
    """Build everything that a run uses, and return its data; loggers write to ``folder``."""
    reasons.attempt(job.check_config, run)
    if run.resume not in (None, AUTO):
        reasons.attempt(read_checkpoint, run.resume)
    trainer = reasons.attempt(build_trainer, run, folder)
    if trainer is not None:
        reasons.attempt(build_renderer, run, trainer.strategy.root_device)
    for options in (run.loss, run.optimizer, run.metrics):
        reasons.attempt(options.build)
    model = reasons.attempt(GHGS.from_config, run.plain, empty=True)
    data = reasons.attempt(build_data, run.with_changes(data={"workers": 0}))
    if model is not None and run.init_from is not None:
        reasons.attempt(start.initialize, model, run.init_from, run.init_strict, run.allow_random_encoder)
    if model is not None and data is not None:
        reasons.attempt(check_size, data, Predictor(model))
        if run.feature_cache is not None and _is_rendered(data, ["train"]):
            reasons.attempt(run.feature_cache.needs, model, data)
    return data


def _read_data(run: Run, data: PhotographsDataModule, reasons: _Reasons) -> None:
    """Look for all files of the data, and read a batch if none is missing."""
    split = run.evaluation.split
    if hasattr(data.dataset, "cache_dir") and not _is_rendered(data, ["train", "val", split]):
        return
    chamfer = getattr(getattr(run.loss, "weights", None), "chamfer", None)  # plug-ins may lack it
    expected = f"expected body vertices for loss.weights.chamfer={chamfer} (0 does without); found none"
    missing = _Reasons()
    for phase in dict.fromkeys(("train", split)):
        if phase in data.dataset.split_names:
            bodies = expected if chamfer and phase == "train" else None
            missing.attempt(_find_missing_files, data, phase, bodies, missing)
    reasons += missing
    if missing:
        return
    batch = reasons.attempt(data.training_batch, 0)  # also reads the contents of files
    reasons.attempt(check_evaluation, run, data)
    if chamfer and batch is not None and batch.body_vertices is None:
        place = data.photographs("train").reader.body_place(batch.subjects[0])
        reasons.append(f"{place}: {expected}")


def _find_missing_files(
    data: PhotographsDataModule, phase: str, bodies: str | None, missing: _Reasons
) -> None:
    """Add a line for each missing file of a phase; ``bodies`` is the message for a missing body, None: no
    body is required."""
    reader = data.dataset.reader(phase)
    for name in reader.subjects:
        body = reader.body_place(name)
        for path in reader.files(name):
            if not path.exists():
                missing.append(f"{path}: expected a file of the data set; found none")
        if bodies and isinstance(body, Path) and not body.exists():
            missing.append(f"{body}: {bodies}")


def _is_rendered(data: PhotographsDataModule, splits: Iterable[str]) -> bool:
    """Whether each of these splits has readable subjects."""
    try:
        return all(bool(data.subjects(split)) for split in splits)
    except (InputError, OSError):
        return False


def _summarize(lines: Iterable[str]) -> list[str]:
    """Keep the first of lines that differ only in numbers, with the number of similar ones, such as
    ``img/0001.png: expected a file; found none``."""
    alike: dict[str, list[str]] = {}
    for line in dict.fromkeys(lines):
        alike.setdefault(re.sub(r"\d+", "#", line), []).append(line)
    return [
        first if not others else f"{first} (and {len(others)} more like it)"
        for first, *others in alike.values()
    ]


def plan(run: Run) -> None:
    """Print the plan of a single run, see :func:`ghgs_lit.runs.sweep.print_plan`.

    Raises:
        InputError: Something is missing.
    """
    directory = RunDirectory(output_dir()).of(run)
    item = PlannedRun(tuple(overrides()), run, directory)
    print_plan([item], directory.path, rehearse)
