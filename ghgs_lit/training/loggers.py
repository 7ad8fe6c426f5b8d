"""Loggers that continue after a restart, and the values by which runs are compared."""

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only
from torch.utils.tensorboard.summary import hparams

from ghgs_lit.config.keys import is_hyperparameter, key_of, lookup
from ghgs_lit.config.options import Options
from ghgs_lit.errors import installed
from ghgs_lit.files import write_atomically
from ghgs_lit.parsing import read_rows
from ghgs_lit.runs.run import RunDirectory

#: Values of the measurement by which runs are compared; ``metrics.json`` has all.
COMPARED = ("psnr", "ssim", "depth_error_mm")
#: Number of input views at which HParams compares runs, of those that were measured at several.
_VIEWS = 4
#: Groups of tags that TensorBoard shows first: it sorts them by name.
_FIRST = ("loss", "measured", "val", "values", "view")
#: Settings that compare runs even where all have the same.
_ALWAYS = ("seed", "views")
Value = str | int | float | bool


class _StepsTaken:
    """Counts steps taken, as checkpoints and pictures do; for Lightning the first step is 0."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log values.

        Args:
            metrics: values by name.
            step: of Lightning, one less than the number of steps taken."""
        super().log_metrics(metrics, None if step is None else step + 1)


class CsvLog(_StepsTaken, CSVLogger):
    """Lightning's ``metrics.csv``, continued by a run that resumes in the same folder."""

    def resume(self, step: int) -> None:
        """Keep the rows of earlier steps, as later ones are trained again.

        Args:
            step: number of steps taken, from where the run goes on."""
        path = Path(self.log_dir) / "metrics.csv"
        rows = read_rows(path) if path.is_file() else []
        # A killed run may have left an incomplete last line.
        rows = [row for row in rows if (row.get("step") or "").isdecimal() and int(row["step"]) <= step]
        with warnings.catch_warnings():
            # the rows are written again below
            warnings.filterwarnings("ignore", ".*will be deleted")
            writer = self.experiment  # starts with an empty file
        writer.metrics = [{name: value for name, value in row.items() if value} for row in rows]
        writer.save()


class TensorBoardLog(_StepsTaken, TensorBoardLogger):
    """TensorBoard's event files, continued by a run that resumes in the same folder."""

    def resume(self, step: int) -> None:
        """Drop what was logged later, from the files, and from a TensorBoard that has read them.

        Args:
            step: number of steps taken, from where the run goes on."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        for path in sorted(Path(self.log_dir).glob("events.out.tfevents.*")):
            _drop_events_after(path, step)
        start = SessionLog(status=SessionLog.START)
        self.experiment.file_writer.add_event(Event(session_log=start), step + 1)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log without the epoch that Lightning adds. A killed process loses nothing that it logged.

        Args:
            metrics: values by name; what is no loss or validation comes below ``work/``.
            step: of Lightning."""
        shown = {}
        for name, value in metrics.items():
            is_first = name.split("/")[0] in _FIRST
            shown[name if is_first else f"work/{name}"] = value
        shown.pop("work/epoch", None)
        super().log_metrics(shown, step)
        self.experiment.flush()


def _drop_events_after(path: Path, step: int) -> None:
    """Write a file of events again without those after a step."""
    from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
    from tensorboard.compat.proto.event_pb2 import Event
    from tensorboard.summary.writer.record_writer import RecordWriter

    def write(temporary: Path) -> None:
        with open(temporary, "wb") as file:
            writer = RecordWriter(file)
            for record in RawEventFileLoader(str(path)).Load():
                if Event.FromString(record).step <= step:
                    writer.write(record)

    write_atomically(path, write)


class CsvOptions(Options):
    """Logged values in ``<run>/csv/metrics.csv``."""

    def build(self, save_dir: str) -> CsvLog:
        """The logger of the run in ``save_dir``."""
        return CsvLog(save_dir, name="csv", version="", flush_logs_every_n_steps=1)


class TensorBoardOptions(Options):
    """TensorBoard's files in ``<run>/tensorboard``; of a run of a grid in
    ``<sweep>/tb/<what sets it apart>``, since TensorBoard names runs by their folders."""

    def build(self, save_dir: str) -> TensorBoardLog:
        """The logger of the run in ``save_dir``."""
        return TensorBoardLog(RunDirectory(Path(save_dir)).curves, name="", version="")


class WandbLog(WandbLogger):
    """Weights & Biases: one run there for each run here,
    however often it is interrupted or moved."""

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log at the number of steps taken, by which steps that are trained again replace nothing.

        Args:
            metrics: values by name.
            step: of Lightning."""
        taken = None if step is None else step + 1
        self.experiment.log({**metrics, "trainer/global_step": taken}, step=taken)


class WandbOptions(Options):
    """Weights & Biases (extra ``wandb``); ``WANDB_PROJECT`` and ``WANDB_MODE`` of the
    environment count."""

    def build(self, save_dir: str) -> WandbLog:
        """The logger of the run in ``save_dir``; InputError: the extra is not installed."""
        installed("wandb", "wandb", "logger.wandb")
        project = os.environ.get("WANDB_PROJECT", "ghgs_lit")
        identity = RunDirectory(Path(save_dir)).marker
        return WandbLog(project=project, save_dir=save_dir, id=identity and identity.id)


@rank_zero_only
def begin(loggers: Sequence[Logger], config: str, step: int | None) -> None:
    """Begin the logs of a run, or continue those in the same folder.

    Args:
        loggers: of the run.
        config: its resolved configuration as YAML, for the tab Text of TensorBoard.
        step: number of steps taken, from where it goes on; None: a new run."""
    for logger in loggers:
        if step is not None and isinstance(logger, (CsvLog, TensorBoardLog)):
            logger.resume(step)
        if isinstance(logger, TensorBoardLog):
            logger.experiment.add_text("configuration", f"```yaml\n{config}```", step or 0)


@rank_zero_only
def log_results(
    loggers: Sequence[Logger],
    values: Mapping[str, Value],
    summary: Sequence[Mapping[str, Any]],
    table: str,
    step: int,
) -> None:
    """Log what sets a run apart, which CSV has in ``config.yaml``, and its final numbers.

    Args:
        loggers: of the run.
        values: of :func:`hyperparameters`.
        summary: of ``metrics.json``.
        table: the same in Markdown.
        step: number of steps after which the weights were measured."""
    for logger in loggers:
        rows = summary
        if isinstance(logger, TensorBoardLog):
            # Its tab HParams compares runs at one number of views, its tab Text has the whole measurement.
            rows = [next((row for row in summary if row["views"] == _VIEWS), summary[0])]
            for part in hparams(dict(values), final_numbers(rows)):
                logger.experiment._get_file_writer().add_summary(part)
            logger.experiment.add_text("measurement", table, step)
        elif not isinstance(logger, CSVLogger):
            logger.log_hyperparams(dict(values))
        logger.log_metrics(final_numbers(rows), step - 1)
        logger.save()


def close(loggers: Sequence[Logger]) -> None:
    """Write remaining values and end the loggers' threads, since runs of a sweep share a process.

    Args:
        loggers: of a run that has ended."""
    for logger in loggers:
        # Unused loggers must not start now.
        if isinstance(logger, TensorBoardLogger) and logger._experiment is not None:
            logger._experiment.close()
        elif isinstance(logger, WandbLogger) and logger._experiment is not None:
            logger._experiment.finish()


def final_numbers(summary: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Values by which runs are compared.

    Args:
        summary: of ``metrics.json``, a row for each protocol.

    Returns:
        Such as ``measured/psnr_v4_release``; only defined values."""
    numbers = {}
    for row in summary:
        for name in COMPARED:
            if row.get(name) is not None:
                numbers[f"measured/{name}_v{row['views']}_{row['targets']}"] = float(row[name])
    return numbers


def hyperparameters(
    config: Mapping[str, Any], choices: Mapping[str, str], overrides: Sequence[str]
) -> dict[str, Value]:
    """Settings by which runs are compared: what ``overrides`` set, seed and views. Keys that do not
    affect results are left out.

    Args:
        config: the run's.
        choices: the option of each config group.
        overrides: of a run of a grid those that set it apart, else all.

    Returns:
        Values by key; those that are no plain value as text."""
    found: dict[str, Value] = {}
    for key in dict.fromkeys([*map(key_of, overrides), *_ALWAYS]):
        value = choices[key] if key in choices else lookup(config, key)
        if is_hyperparameter(key) and value is not None:
            found[key] = value if isinstance(value, (str, int, float, bool)) else str(value)
    return found
