"""What happens beside the training step: checkpoints, pictures, times."""

import time
from pathlib import Path
from typing import Any

import lightning.pytorch as L
from lightning.pytorch.callbacks import Callback, ModelCheckpoint, ProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from ghgs_lit.errors import require
from ghgs_lit.experiments.pictures import save_png, sheet
from ghgs_lit.types import Batch


class Checkpoints(ModelCheckpoint):
    """Lightning's ModelCheckpoint in ``<run>/checkpoints``; each file replaces the last of its name.

    A file is written aside and renamed by Lightning, so that a killed run leaves the one before whole.
    """

    def __init__(self, **kwargs):
        super().__init__(auto_insert_metric_name=False, enable_version_counter=False, **kwargs)

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        self.dirpath = self.dirpath or str(Path(trainer.default_root_dir) / "checkpoints")
        super().setup(trainer, pl_module, stage)


class RunProgress(ProgressBar):
    """One bar for the whole run, over its budget of steps or of time; epochs mean little here."""

    def __init__(self):
        super().__init__()
        self._bar: Progress | None = None

    def disable(self) -> None:
        """Called by Lightning in all processes but the first."""
        self._is_enabled = False

    def enable(self) -> None:
        self._is_enabled = True

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if not getattr(self, "_is_enabled", True):
            return
        columns = (
            BarColumn(),
            TaskProgressColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[text]}"),
        )
        self._bar = Progress(TextColumn("training"), *columns)
        self._bar.start()
        self._task = self._bar.add_task("training", total=1.0, text="")

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: L.LightningModule, outputs: Any, batch: Batch, batch_idx: int
    ) -> None:
        if self._bar is None:
            return
        shown = {k: v for k, v in self.get_metrics(trainer, pl_module).items() if k != "v_num"}
        numbers = "  ".join(f"{name} {value:.4g}" for name, value in shown.items())
        text = f"step {trainer.global_step}  {numbers}"
        self._bar.update(self._task, completed=pl_module.used_budget, text=text)

    def on_train_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._stop()

    def on_exception(
        self, trainer: L.Trainer, pl_module: L.LightningModule, exception: BaseException
    ) -> None:
        self._stop()

    def _stop(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


class StepTime(Callback):
    """Logs the seconds of a step and, apart, those spent waiting for data."""

    def on_train_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._ended = time.perf_counter()

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        self._started = time.perf_counter()

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        # The check of the gradient's norm has waited for the device already.
        now = time.perf_counter()
        pl_module.log_dict({"time/data": self._started - self._ended, "time/step": now - self._started})
        self._ended = now


class Pictures(Callback):
    """Writes inputs, depths, targets and renders of the first subjects of each validation.

    To TensorBoard and to ``<run>/pictures/step_<step>/<subject>.png``.
    """

    def __init__(self, subjects: int = 2):
        require(subjects >= 0, "callbacks.pictures.subjects", "a number of at least 0", subjects)
        self.subjects = subjects
        self._left = 0

    def on_validation_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._left = 0 if trainer.sanity_checking else self.subjects

    @rank_zero_only
    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: dict[str, Any],
        batch: Batch,
        *args: Any,
    ) -> None:
        for element in range(min(self._left, len(batch.images))):
            prediction = outputs["prediction"]
            picture = sheet(
                batch, outputs["rendering"].image, element, prediction.depth, prediction.depth_valid
            )
            name = batch.subjects[element] if batch.subjects else f"subject_{self.subjects - self._left}"
            folder = Path(trainer.default_root_dir) / "pictures" / f"step_{trainer.global_step:06d}"
            save_png(picture, folder / f"{name}.png")
            for logger in trainer.loggers:
                if isinstance(logger, TensorBoardLogger):
                    logger.experiment.add_image(
                        f"val/{name}", picture, trainer.global_step, dataformats="HWC"
                    )
            self._left -= 1
