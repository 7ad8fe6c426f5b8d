"""Loggers that continue after a restart, and the values logged for the comparison of runs."""

import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from torch.utils.tensorboard.summary import hparams

from ghgs_lit.config.keys import is_hyperparameter, key_of, lookup
from ghgs_lit.config.options import Options
from ghgs_lit.files import write_atomically
from ghgs_lit.parsing import read_rows
from ghgs_lit.runs.job import find_curves

#: Metrics by which runs are compared; ``metrics.json`` contains all.
COMPARED = ("psnr", "ssim", "depth_error_mm")
#: Number of input views at which HParams compares runs that were measured with several numbers.
_VIEWS = 4
#: Settings that are always logged as hyperparameters.
_ALWAYS = ("seed", "views")
Value = str | int | float | bool


class _StepsTaken:
    """Logs at the number of steps taken, as checkpoints and pictures do; Lightning counts from 0."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log values by name; ``step`` is Lightning's, one less than the number of steps taken."""
        super().log_metrics(metrics, None if step is None else step + 1)


class CsvLog(_StepsTaken, CSVLogger):
    """Lightning's ``metrics.csv``, continued by a run that resumes in the same folder."""

    def resume(self, step: int) -> None:
        """Remove rows of later steps, which are trained again.

        Args:
            step: number of steps taken at which the run continues."""
        path = Path(self.log_dir) / "metrics.csv"
        rows = read_rows(path) if path.is_file() else []
        # A killed run may have left an incomplete last line.
        rows = [row for row in rows if (row.get("step") or "").isdecimal() and int(row["step"]) <= step]
        with warnings.catch_warnings():
            # The rows are written again below.
            warnings.filterwarnings("ignore", ".*will be deleted")
            writer = self.experiment  # creates an empty file
        writer.metrics = [{name: value for name, value in row.items() if value} for row in rows]
        writer.save()


class TensorBoardLog(_StepsTaken, TensorBoardLogger):
    """TensorBoard's event files, continued by a run that resumes in the same folder."""

    def resume(self, step: int) -> None:
        """Remove later events from the files, and from a TensorBoard that has already read them.

        Args:
            step: number of steps taken at which the run continues."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        for path in sorted(Path(self.log_dir).glob("events.out.tfevents.*")):
            _drop_events_after(path, step)
        start = SessionLog(status=SessionLog.START)
        self.experiment.file_writer.add_event(Event(session_log=start), step + 1)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log values by tag without Lightning's epoch, and flush, so that a killed process loses none."""
        shown = {name: value for name, value in metrics.items() if name != "epoch"}
        super().log_metrics(shown, step)
        self.experiment.flush()


def _drop_events_after(path: Path, step: int) -> None:
    """Rewrite a file of events without those after ``step``."""
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
        """Create the logger of the run in ``save_dir``."""
        return CsvLog(save_dir, name="csv", version="", flush_logs_every_n_steps=1)


class TensorBoardOptions(Options):
    """TensorBoard's event files in ``<run>/tensorboard``; for a run of a sweep in a folder there that is
    named after its settings, as TensorBoard names runs by their folders."""

    def build(self, save_dir: str) -> TensorBoardLog:
        """Create the logger of the run in ``save_dir``."""
        return TensorBoardLog(find_curves(Path(save_dir)), name="", version="")


@rank_zero_only
def begin(loggers: Sequence[Logger], config: str, step: int | None) -> None:
    """Begin the logs of a run, or continue those in its folder.

    Args:
        config: the resolved configuration as YAML, for TensorBoard's Text tab.
        step: number of steps taken at which the run continues; None: a new run."""
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
    """Log a run's hyperparameters and final metrics. CSV gets no hyperparameters: ``config.yaml`` has
    them.

    Args:
        values: hyperparameters, from :func:`hyperparameters`.
        summary: rows of ``metrics.json``, one per protocol.
        table: the summary as a Markdown table.
        step: number of steps after which the weights were measured."""
    for logger in loggers:
        rows = summary
        if isinstance(logger, TensorBoardLog):
            # The HParams tab compares runs at one number of views, the Text tab shows the whole table.
            rows = [next((row for row in summary if row["views"] == _VIEWS), summary[0])]
            for part in hparams(dict(values), final_numbers(rows)):
                logger.experiment._get_file_writer().add_summary(part)
            logger.experiment.add_text("measurement", table, step)
        elif not isinstance(logger, CSVLogger):
            logger.log_hyperparams(dict(values))
        logger.log_metrics(final_numbers(rows), step - 1)
        logger.save()


def close(loggers: Sequence[Logger]) -> None:
    """Flush the loggers of a finished run and end their threads, as runs of a sweep share a process."""
    for logger in loggers:
        # Reading ``experiment`` would start loggers that were never used.
        if isinstance(logger, TensorBoardLogger) and logger._experiment is not None:
            logger._experiment.close()


def final_numbers(summary: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Metrics by which runs are compared (:data:`COMPARED`).

    Args:
        summary: rows of ``metrics.json``, one per protocol.

    Returns:
        Values by tags such as ``measured/psnr_v4_release``, without undefined ones."""
    numbers = {}
    for row in summary:
        for name in COMPARED:
            if row.get(name) is not None:
                numbers[f"measured/{name}_v{row['views']}_{row['targets']}"] = float(row[name])
    return numbers


def hyperparameters(
    config: Mapping[str, Any], choices: Mapping[str, str], overrides: Sequence[str]
) -> dict[str, Value]:
    """Settings by which runs are compared: those of ``overrides``, the seed and the number of views,
    without keys that do not affect results.

    Args:
        choices: the selected option of each config group.
        overrides: of the command line.

    Returns:
        Values by key; lists and dicts are converted to text."""
    found: dict[str, Value] = {}
    for key in dict.fromkeys([*map(key_of, overrides), *_ALWAYS]):
        value = choices[key] if key in choices else lookup(config, key)
        if is_hyperparameter(key) and value is not None:
            found[key] = value if isinstance(value, (str, int, float, bool)) else str(value)
    return found
