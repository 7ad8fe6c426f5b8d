"""Loggers that survive a restart, and what a sweep compares its runs by."""

import csv
import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only

from ghgs_lit.errors import InputError

#: The final numbers that runs are compared by, where they were measured: TensorBoard's HParams tab shows
#: the first five of its metrics at once. ``metrics.json`` has all.
COMPARED = ("depth_error_mm", "flip", "lpips", "psnr", "psnr_box", "ssim")
#: Groups of the configuration that change no number, and keys that say where a run starts.
_SILENT = ("hydra", "logger", "callbacks", "evaluation", "resume", "dry_run", "sweep")

Value = str | int | float | bool


class CsvLog(CSVLogger):
    """Lightning's ``metrics.csv``, which a run that goes on in the same folder continues."""

    def go_on(self, step: int) -> None:
        """Keep the rows of the steps before ``step``; the rest is trained, and written, again."""
        path = Path(self.log_dir) / "metrics.csv"
        rows = []
        if path.is_file():
            with open(path, newline="") as file:
                rows = [row for row in csv.DictReader(file) if _is_before(row.get("step"), step)]
        writer = self.experiment  # starts with an empty file
        writer.metrics = [{name: value for name, value in row.items() if value} for row in rows]
        writer.save()


def _is_before(found: str | None, step: int) -> bool:
    """Also refuses the torn last line of a killed run."""
    return found is not None and found.isdecimal() and int(found) < step


class TensorBoardLog(TensorBoardLogger):
    """TensorBoard's event files, with the run's place in the HParams tab."""

    def go_on(self, step: int) -> None:
        """Let TensorBoard forget what was logged at and after ``step``."""
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog

        start = SessionLog(status=SessionLog.START)
        self.experiment.file_writer.add_event(Event(session_log=start), step)

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        """Without the epoch, that Lightning adds: steps count here."""
        super().log_metrics({name: value for name, value in metrics.items() if name != "epoch"}, step)

    @rank_zero_only
    def log_hyperparams(self, params: Mapping[str, Value], *args: Any, **kwargs: Any) -> None:
        """A session without a list of metrics: TensorBoard then compares all runs by all they have."""
        from torch.utils.tensorboard.summary import hparams

        _, session, _ = hparams(dict(params), {})
        self.experiment.file_writer.add_summary(session)

    @rank_zero_only
    def log_results(self, results: Mapping[str, float], step: int) -> None:
        """The final numbers; the session has ended well."""
        from torch.utils.tensorboard.summary import hparams

        self.log_metrics(dict(results), step)
        _, _, end = hparams({}, {})
        self.experiment.file_writer.add_summary(end)
        self.experiment.flush()


class WandbLog(WandbLogger):
    """Lightning's logger for Weights & Biases (extra ``wandb``)."""

    def __init__(self, **kwargs: Any):
        if importlib.util.find_spec("wandb") is None:
            raise InputError(
                "logger.wandb: expected the package wandb (pip install 'ghgs-lit[wandb]'); found none"
            )
        super().__init__(**kwargs)


@rank_zero_only
def go_on(loggers: Sequence[Logger], step: int) -> None:
    """Continue the logs of a run that is resumed at ``step`` in the folder that it was begun in."""
    for logger in loggers:
        if isinstance(logger, (CsvLog, TensorBoardLog)):
            logger.go_on(step)


@rank_zero_only
def log_hyperparameters(loggers: Sequence[Logger], values: Mapping[str, Value]) -> None:
    """What this run differs by from the others of its sweep."""
    for logger in loggers:
        if not isinstance(logger, CSVLogger):  # its hparams.yaml would repeat config.yaml
            logger.log_hyperparams(dict(values))


@rank_zero_only
def log_results(loggers: Sequence[Logger], summary: Sequence[Mapping[str, Any]], step: int) -> None:
    """Log the final numbers of a run: ``hparam/<metric>`` of the first protocol, others by their name."""
    results = final_numbers(summary)
    for logger in loggers:
        if isinstance(logger, TensorBoardLog):
            logger.log_results(results, step)
        else:
            logger.log_metrics(results, step)
            logger.save()


def final_numbers(summary: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """``hparam/psnr`` of the first protocol; ``hparam_v4_midway/psnr`` of others; not what is undefined."""
    return {
        (f"hparam_v{row['views']}_{row['targets']}" if place else "hparam") + f"/{name}": float(row[name])
        for place, row in enumerate(summary)
        for name in COMPARED
        if row.get(name) is not None
    }


def hyperparameters(
    config: Mapping[str, Any], choices: Mapping[str, str], overrides: Sequence[str]
) -> dict[str, Value]:
    """What a run can be compared by: its choices of config groups, its seed, and every changed value.

    ``config`` is plain data; ``choices`` says which member of each group it is made of; ``overrides`` are
    the command line's (``key=value``). Groups that do not change a number are left out.
    """
    found: dict[str, Value] = {
        group: name for group, name in choices.items() if name is not None and _matters(group)
    }
    for key in [part.split("=", 1)[0].lstrip("+~") for part in overrides]:
        value = _lookup(config, key.split("."))
        if key not in choices and _matters(key) and value is not None:
            found[key] = value if isinstance(value, (str, int, float, bool)) else str(value)
    if "seed" in config:
        found["seed"] = config["seed"]
    return found


def _matters(key: str) -> bool:
    return key.replace("/", ".").split(".")[0] not in _SILENT


def _lookup(config: Any, path: Sequence[str]) -> Any:
    for name in path:
        if not isinstance(config, Mapping) or name not in config:
            return None
        config = config[name]
    return config
