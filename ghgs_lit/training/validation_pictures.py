"""Pictures, attention and point clouds of the first validation subjects, while a run trains."""

from pathlib import Path
from typing import Any

import lightning.pytorch as L
import numpy as np
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only

from ghgs_lit.config.options import Index, Options
from ghgs_lit.geometry.padding import pad_to_patches
from ghgs_lit.recalibration import Recalibration
from ghgs_lit.recalibration.inspection import attention_of
from ghgs_lit.types import Batch
from ghgs_lit.visualization.attention import attention_sheet, chosen_token
from ghgs_lit.visualization.clouds import clouds
from ghgs_lit.visualization.pictures import save_png, sheet

#: Maximum number of points of each cloud.
CLOUD_POINTS = 6000
#: How TensorBoard shows clouds: points of two centimetres through a perspective camera.
CLOUD_VIEW = {
    "camera": {"cls": "PerspectiveCamera", "fov": 40},
    "material": {"cls": "PointsMaterial", "size": 0.02},
}


class _FirstSubjects(Callback):
    """Calls :meth:`show` for the first ``subjects`` subjects of each validation, in one process."""

    def __init__(self, subjects: int):
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
            name = batch.subjects[element] if batch.subjects else f"subject_{self.subjects - self._left}"
            self.show(trainer, outputs, batch, element, name)
            self._left -= 1

    def show(
        self, trainer: L.Trainer, outputs: dict[str, Any], batch: Batch, element: int, name: str
    ) -> None:
        """Draw subject ``element`` of ``batch``; ``outputs`` are those of the validation step."""
        raise NotImplementedError


def _publish(trainer: L.Trainer, tag: str, picture: np.ndarray, file: str) -> None:
    """Write ``<run>/pictures/step_<step>/<file>.png`` and log it as ``tag`` where loggers take pictures."""
    step = trainer.global_step
    save_png(picture, Path(trainer.default_root_dir) / "pictures" / f"step_{step:06d}" / f"{file}.png")
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(tag, picture, step, dataformats="HWC")
        elif isinstance(logger, WandbLogger):
            logger.log_image(tag, [picture])


class PicturesOptions(Options):
    """Inputs, depths, targets, renders and errors side by side."""

    group = "callbacks.pictures"
    subjects: Index = 2
    """Number of subjects, the first of each validation; 0: none."""

    def build(self) -> "Pictures":
        return Pictures(self.subjects)


class Pictures(_FirstSubjects):
    """Inputs, depths, targets, renders and errors side by side: ``sheet/<subject>``."""

    def show(
        self, trainer: L.Trainer, outputs: dict[str, Any], batch: Batch, element: int, name: str
    ) -> None:
        prediction = outputs["prediction"]
        picture = sheet(batch, outputs["rendering"].image, element, prediction.depth, prediction.depth_valid)
        _publish(trainer, f"sheet/{name}", picture, name)


class AttentionOptions(Options):
    """What one token attends to in the recalibration."""

    group = "callbacks.attention"
    subjects: Index = 1
    """Number of subjects; 0: none."""
    token: tuple[Index, Index, Index] | None = None
    """View, row and column on the grid of tokens; null: the middle of the subject in its first view."""

    def build(self) -> "Attention":
        return Attention(self)


class Attention(_FirstSubjects):
    """What one token attends to, drawn on the views: ``attention/<subject>``.

    The token's place is on the grid of padded photographs, where the model pads.
    """

    def __init__(self, options: AttentionOptions):
        super().__init__(options.subjects)
        self.token = options.token
        self._hook, self._seen = None, None

    def on_validation_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        super().on_validation_epoch_start(trainer, pl_module)
        stage = getattr(pl_module.model, "recalibration", None)
        if self._left and isinstance(stage, Recalibration):
            self._hook = stage.register_forward_pre_hook(self._see)

    def on_validation_batch_start(self, *args: Any) -> None:
        self._seen = None

    def _see(self, stage: Recalibration, inputs: tuple) -> None:
        self._seen = (stage, *inputs)

    def show(
        self, trainer: L.Trainer, outputs: dict[str, Any], batch: Batch, element: int, name: str
    ) -> None:
        if self._seen is None:
            return
        stage, tokens, points = self._seen
        token = chosen_token(tokens, points, element, self.token)
        attention = None if token is None else attention_of(stage, tokens, points, token)
        if attention is not None:
            padding = pad_to_patches(batch.masks, tokens.patch_size)
            picture = attention_sheet(padding.pad_batch(batch) if padding else batch, tokens, attention)
            _publish(trainer, f"attention/{name}", picture, f"{name}_attention")
        if self._left == 1:
            self._forget()

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._forget()

    def _forget(self) -> None:
        if self._hook is not None:
            self._hook.remove()
        self._hook, self._seen = None, None


class PointCloudOptions(Options):
    """Predicted points and bodies in TensorBoard."""

    group = "callbacks.point_clouds"
    subjects: Index = 1
    """Number of subjects; 0: none."""

    def build(self) -> "PointClouds":
        return PointClouds(self.subjects)


class PointClouds(_FirstSubjects):
    """Predicted points and the body's vertices in TensorBoard's mesh tab: ``<subject>/points`` and so on."""

    def show(
        self, trainer: L.Trainer, outputs: dict[str, Any], batch: Batch, element: int, name: str
    ) -> None:
        loggers = [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
        if not loggers:
            return
        for kind, (positions, colors) in clouds(batch, outputs["prediction"], element, CLOUD_POINTS).items():
            for logger in loggers:
                logger.experiment.add_mesh(
                    f"{name}/{kind}",
                    positions[None],
                    (255 * colors[None]).byte(),
                    config_dict=CLOUD_VIEW,
                    global_step=trainer.global_step,
                )
