"""Loggers that continue after a restart, and the values by which runs are compared."""

import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only

from ghgs_lit.config.keys import NOT_HYPERPARAMETERS, is_below, lookup
from ghgs_lit.config.options import Options
from ghgs_lit.errors import installed
from ghgs_lit.readers import read_rows

#: Final values by which runs are compared: TensorBoard's HParams tab shows the first five of them at once.
#: ``metrics.json`` has all.
COMPARED = ("depth_error_mm", "flip", "lpips", "psnr", "psnr_box", "ssim")
Value = str | int | float | bool


class _StepsTaken:
    """Counts steps taken, as checkpoints and pictures do; for Lightning the first step is 0."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        super().log_metrics(metrics, None if step is None else step + 1)


class CsvLog(_StepsTaken, CSVLogger):
    """Lightning's ``metrics.csv``, continued by a run that resumes in the same folder."""

    def resume(self, step: int) -> None:
        """Keep the rows up to ``step``, as later steps are trained again."""
        path = Path(self.log_dir) / "metrics.csv"
        rows = read_rows(path) if path.is_file() else []
        # A killed run may have left an incomplete last line.
        rows = [row for row in rows if (row.get("step") or "").isdecimal() and int(row["step"]) <= step]
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*will be deleted")  # the rows are written again below
            writer = self.experiment  # starts with an empty file
        writer.metrics = [{name: value for name, value in row.items() if value} for row in rows]
        writer.save()


class TensorBoardLog(_StepsTaken, TensorBoardLogger):
    """TensorBoard's event files."""

    def resume(self, step: int) -> None:
        """Make TensorBoard drop values logged after ``step``."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        start = SessionLog(status=SessionLog.START)
        self.experiment.file_writer.add_event(Event(session_log=start), step + 1)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Log without the epoch that Lightning adds."""
        super().log_metrics({name: value for name, value in metrics.items() if name != "epoch"}, step)


class CsvOptions(Options):
    """Logged values in ``<run>/csv/metrics.csv``."""

    def build(self, save_dir: str) -> CsvLog:
        return CsvLog(save_dir, name="csv", version="")


class TensorBoardOptions(Options):
    """TensorBoard's files in ``<run>/tensorboard``."""

    def build(self, save_dir: str) -> TensorBoardLog:
        return TensorBoardLog(save_dir, name="tensorboard", version="")


class WandbLog(_StepsTaken, WandbLogger):
    """Weights & Biases."""


class WandbOptions(Options):
    """Weights & Biases (extra ``wandb``); ``WANDB_PROJECT`` and ``WANDB_MODE`` of the environment count."""

    def build(self, save_dir: str) -> WandbLog:
        installed("wandb", "wandb", "logger.wandb")
        return WandbLog(project=os.environ.get("WANDB_PROJECT", "ghgs_lit"), save_dir=save_dir)


@rank_zero_only
def resume(loggers: Sequence[Logger], step: int) -> None:
    """Continue the logs of a run that resumes at ``step`` in the same folder."""
    for logger in loggers:
        if isinstance(logger, (CsvLog, TensorBoardLog)):
            logger.resume(step)


@rank_zero_only
def log_results(
    loggers: Sequence[Logger], values: Mapping[str, Value], summary: Sequence[Mapping[str, Any]], step: int
) -> None:
    """Log the :func:`hyperparameters` ``values``, which CSV has in ``config.yaml``, and :func:`final_numbers`
    of the weights after ``step``. ``summary``: of ``metrics.json``."""
    results = final_numbers(summary)
    for logger in loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.log_hyperparams(dict(values), results)
            continue
        if not isinstance(logger, CSVLogger):
            logger.log_hyperparams(dict(values))
        logger.log_metrics(results, step - 1)
        logger.save()


def close(loggers: Sequence[Logger]) -> None:
    """Write remaining values and end the loggers' threads, since runs of a sweep share a process."""
    for logger in loggers:
        # Unused loggers must not start now.
        if isinstance(logger, TensorBoardLogger) and logger._experiment is not None:
            logger._experiment.close()
        elif isinstance(logger, WandbLogger) and logger._experiment is not None:
            logger._experiment.finish()


def final_numbers(summary: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """``hparam/psnr`` of the first protocol, ``hparam_v4_midway/psnr`` of others; only defined values."""
    return {
        (f"hparam_v{row['views']}_{row['targets']}" if number else "hparam") + f"/{name}": float(row[name])
        for number, row in enumerate(summary)
        for name in COMPARED
        if row.get(name) is not None
    }


def hyperparameters(
    config: Mapping[str, Any], choices: Mapping[str, str], overrides: Sequence[str]
) -> dict[str, Value]:
    """Settings by which runs are compared: options of config groups, the seed, and every changed value. Keys
    that do not affect results are left out. ``choices``: the option of each config group."""
    found: dict[str, Value] = {
        group: name for group, name in choices.items() if name is not None and _matters(group)
    }
    for key in [part.split("=", 1)[0].lstrip("+~") for part in overrides]:
        value = lookup(config, key)
        if key not in choices and _matters(key) and value is not None:
            found[key] = value if isinstance(value, (str, int, float, bool)) else str(value)
    if "seed" in config:
        found["seed"] = config["seed"]
    return found


def _matters(key: str) -> bool:
    return not is_below(key.replace("/", "."), NOT_HYPERPARAMETERS)
