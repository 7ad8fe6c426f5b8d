"""Checks of ``dry_run``: everything that runs require before their first step."""

import re
import tempfile
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ghgs_lit.cli.inputs import build_data, build_renderer, check_size, overrides
from ghgs_lit.cli.runtime import output_dir
from ghgs_lit.cli.train import build_trainer, silence_lightning
from ghgs_lit.errors import InputError
from ghgs_lit.evaluation.protocols import check_evaluation
from ghgs_lit.execution.predictor import Predictor
from ghgs_lit.method.model import GHGS
from ghgs_lit.runs import job
from ghgs_lit.runs.results import config_hash
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.runs.sweep import PlannedRun, print_plan
from ghgs_lit.training import start
from ghgs_lit.weights.checkpoint import read_checkpoint

if TYPE_CHECKING:
    from ghgs_lit.cli.verbs import Train
    from ghgs_lit.data.datamodule import PhotographsDataModule
    from ghgs_lit.data.dataset import DataSet


def rehearse(planned: Sequence[PlannedRun]) -> list[str]:
    """Check the prerequisites of runs, each configuration once; renders and writes nothing and takes no
    step.

    Returns:
        One line for everything that is missing.
    """
    findings = _Findings()
    runs = {config_hash({**item.run.plain, "seed": 0}): item.run for item in planned}
    # Configurations of a sweep often have the same data.
    of_data = ("data", "augmentation", "views", "targets", "loss", "evaluation")
    data = {config_hash({key: run.plain[key] for key in of_data}): run for run in runs.values()}
    silence_lightning()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for item in planned:
            if item.directory.checkpoint is not None:
                findings.attempt(read_checkpoint, item.directory.checkpoint)
        for run in runs.values():
            findings.check(run, Path(folder))
        for run in data.values():
            findings.check_data(run.with_changes(data={"workers": 0}))
    return _summarize(findings.reasons)


class _Findings:
    """Reasons, stored as keys in order of appearance."""

    def __init__(self) -> None:
        self.reasons: dict[str, None] = {}

    def attempt(self, function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
        """Result of a call; None if it raises an input error, which becomes a reason."""
        try:
            return function(*arguments, **named)
        except (InputError, OSError) as error:
            self.reasons[" ".join(str(error).split())] = None
            return None

    def check(self, run: "Train", folder: Path) -> None:
        """Build everything that a run uses; loggers write to ``folder``."""
        self.attempt(job.check_config, run)
        if run.resume not in (None, "auto"):
            self.attempt(read_checkpoint, run.resume)
        trainer = self.attempt(build_trainer, run, folder)
        if trainer is not None:
            self.attempt(build_renderer, run, trainer.strategy.root_device)
        for options in (run.loss, run.optimizer, run.metrics):
            self.attempt(options.build)
        model = self.attempt(GHGS.from_config, run.plain, empty=True)
        if model is None:
            return
        if run.init_from is not None:
            options = run.init_strict, run.allow_random_encoder
            self.attempt(start.initialize, model, run.init_from, *options)
        data = self.attempt(build_data, run)
        if data is not None:
            self.attempt(check_size, data, Predictor(model))
            if run.feature_cache is not None and _is_rendered(data, ["train"]):
                self.attempt(run.feature_cache.needs, model, data)

    def check_data(self, run: "Train") -> None:
        """Look for all files of the data, and read a batch if none is missing."""
        data = self.attempt(build_data, run)
        split = run.evaluation.split
        if data is None or (
            hasattr(data.dataset, "cache_dir") and not _is_rendered(data, ["train", "val", split])
        ):
            return
        chamfer = getattr(getattr(run.loss, "weights", None), "chamfer", None)  # plug-ins may lack it
        expected = f"expected body vertices for loss.weights.chamfer={chamfer} (0 does without); found none"
        before = len(self.reasons)
        for phase in dict.fromkeys(("train", split)):
            if phase not in data.dataset.split_names:
                continue
            bodies = expected if chamfer and phase == "train" else None
            lines = self.attempt(_find_missing_files, data.dataset, phase, bodies)
            self.reasons |= dict.fromkeys(lines or ())
        if len(self.reasons) > before:
            return
        batch = self.attempt(data.training_batch, 0)  # also reads the contents of files
        self.attempt(check_evaluation, run, data)
        if chamfer and batch is not None and batch.body_vertices is None:
            place = data.photographs("train").reader.body_place(batch.subjects[0])
            self.reasons[f"{place}: {expected}"] = None


def _find_missing_files(dataset: "DataSet", phase: str, bodies: str | None) -> list[str]:
    """One line for each missing file of a phase; ``bodies`` is the message for a missing body, None: no
    body is required."""
    reader = dataset.reader(phase, strict=False)
    lines = list(reader.problems)
    for name in reader.subjects:
        body = reader.body_place(name)
        lacks_body = bodies is not None and isinstance(body, Path) and not body.exists()
        try:
            missing = [path for path in reader.files(name) if not path.exists()]
        except (InputError, OSError) as error:
            lines.append(" ".join(str(error).split()))
            missing = []
        if lacks_body:
            missing = [path for path in missing if path != body]
            lines.append(f"{body}: {bodies}")
        lines += [f"{path}: expected a file of the data set; found none" for path in missing]
    return lines


def _is_rendered(data: "PhotographsDataModule", splits: Iterable[str]) -> bool:
    """Whether each of these splits has readable subjects."""
    try:
        return all(bool(data.subjects(split)) for split in splits)
    except (InputError, OSError):
        return False


def _summarize(lines: Iterable[str]) -> list[str]:
    """Keep the first of lines that differ only in numbers, with the number of similar ones, such as
    ``img/0001.png: expected a file; found none``."""
    alike: dict[str, list[str]] = {}
    for line in lines:
        alike.setdefault(re.sub(r"\d+", "#", line), []).append(line)
    return [
        first if not others else f"{first} (and {len(others)} more like it)"
        for first, *others in alike.values()
    ]


def plan(run: "Train") -> None:
    """Print the plan of a single run, see :func:`ghgs_lit.runs.sweep.print_plan`.

    Raises:
        InputError: Something is missing.
    """
    directory = RunDirectory(output_dir()).of(run)
    item = PlannedRun((), tuple(overrides()), run, directory)
    print_plan([item], directory.path, rehearse)
