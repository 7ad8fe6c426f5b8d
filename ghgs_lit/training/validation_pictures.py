"""Pictures, attention and point clouds of the first validation subjects."""

from pathlib import Path
from typing import Any

import lightning.pytorch as L
import numpy as np
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor

from ghgs_lit.config.options import Index, Options
from ghgs_lit.geometry.padding import pad_to_patches
from ghgs_lit.method.recalibration import Recalibration
from ghgs_lit.method.recalibration.inspection import attention_of, attention_on_other_parts
from ghgs_lit.training.pretext.labels import has_parts, part_shares, token_parts
from ghgs_lit.types import Batch, Prediction
from ghgs_lit.visualization.attention import attention_sheet, chosen_token
from ghgs_lit.visualization.clouds import clouds
from ghgs_lit.visualization.pictures import save_png, sheet

#: TensorBoard's view of clouds: points of two centimetres through a perspective camera.
CLOUD_VIEW = {
    "camera": {"cls": "PerspectiveCamera", "fov": 40},
    "material": {"cls": "PointsMaterial", "size": 0.02},
}


class PicturesOptions(Options):
    """Pictures of the first subjects of each validation;
    of the first one also attention and point clouds."""

    group = "callbacks.pictures"
    subjects: Index = 2
    """Number of subjects; 0: none."""
    token: tuple[Index, Index, Index] | None = None
    """Whose attention is drawn: view, row and column on the grid of tokens of padded photographs;
    null: the middle of the subject in its first view."""

    def build(self) -> "Pictures":
        """The callback."""
        return Pictures(self)


class Pictures(Callback):
    """Logs ``view/sheet/<subject>``, ``view/attention/<subject>``, in TensorBoard's tabs of
    distributions ``values/*`` and in its mesh tab ``<subject>/points``. A sheet has inputs, depths,
    targets, renders and errors. Attention is of one token of the recalibration. Clouds are the
    predicted points and the body's vertices.

    Args:
        options: whom to draw."""

    def __init__(self, options: PicturesOptions):
        self.options = options
        self._left = 0
        self._hook = None
        self._seen = None

    def on_validation_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Watch the recalibration while there are subjects to draw."""
        self._left = 0 if trainer.sanity_checking else self.options.subjects
        stage = getattr(pl_module.model, "recalibration", None)
        if self._left and isinstance(stage, Recalibration):
            self._hook = stage.register_forward_pre_hook(self._see)

    def _see(self, stage: Recalibration, inputs: tuple) -> None:
        """Keep the tokens and points that the recalibration gets."""
        self._seen = (stage, *inputs[:2])

    @rank_zero_only
    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: dict[str, Any],
        batch: Batch,
        *args: Any,
    ) -> None:
        """Draw the next subjects.

        Args:
            trainer, pl_module: of the run.
            outputs: of :meth:`ghgs_lit.training.module.GHGSModule.validation_step`.
            batch: that was validated.
            *args: not used."""
        prediction = outputs["prediction"]
        image = outputs["rendering"].image
        for element in range(min(self._left, len(batch.images))):
            number = self.options.subjects - self._left
            name = batch.subjects[element] if batch.subjects else f"subject_{number}"
            picture = sheet(batch, image, element, prediction.depth, prediction.depth_valid)
            _publish(trainer, f"view/sheet/{name}", picture, name)
            if number == 0:
                self._show_attention(trainer, batch, element, name)
                self._log_other_parts(pl_module, batch)
                _show_clouds(trainer, batch, prediction, element, name)
                _show_distributions(trainer, prediction)
            self._left -= 1
        self._forget()

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Watch no longer."""
        self._forget()

    def _forget(self) -> None:
        if self._hook is not None:
            self._hook.remove()
        self._hook = None
        self._seen = None

    def _show_attention(self, trainer: L.Trainer, batch: Batch, element: int, name: str) -> None:
        """Publish whom the chosen token of an element attends to.

        Args:
            trainer: with the loggers and the folder of the run.
            batch: that the model was called with last.
            element: of the batch.
            name: of its subject, in the names of pictures.
        """
        if self._seen is None:
            return
        stage, tokens, points = self._seen
        token = chosen_token(tokens, points, element, self.options.token)
        attention = None if token is None else attention_of(stage, tokens, points, token)
        if attention is not None:
            padding = pad_to_patches(batch.masks, tokens.patch_size)
            picture = attention_sheet(padding.pad_batch(batch) if padding else batch, tokens, attention)
            _publish(trainer, f"view/attention/{name}", picture, f"{name}_attention")

    def _log_other_parts(self, pl_module: L.LightningModule, batch: Batch) -> None:
        """Log the share of attention on other body parts, for built-in people with true depths."""
        if self._seen is None or batch.depths is None or not has_parts(batch):
            return
        stage, tokens, points = self._seen
        padding = pad_to_patches(batch.masks, tokens.patch_size)
        shares = part_shares(padding.pad_batch(batch) if padding else batch, tokens.patch_size)
        part = token_parts(shares, tokens)
        share = attention_on_other_parts(stage, tokens, points, part)
        pl_module.log(
            "val/attention_on_other_parts", share.mean(), batch_size=len(batch.images), rank_zero_only=True
        )


def distributions(prediction: Prediction) -> dict[str, Tensor]:
    """Values of all Gaussians.

    Args:
        prediction: of a model.

    Returns:
        Finite values by name: opacities, standard deviations in millimetres and, where their pixels
        are known, the distances from these pixels' points, in millimetres."""
    gaussians = prediction.gaussians
    known = {"opacity": gaussians.opacities, "scale_mm": 1000 * gaussians.scales}
    if gaussians.pixel is not None:
        points = prediction.points.pixels.flatten(0, 1).flatten(1, 2)[gaussians.image, gaussians.pixel]
        known["offset_mm"] = 1000 * (gaussians.means - points).norm(dim=-1)
    return {name: values[values.isfinite()] for name, values in known.items()}


def _show_distributions(trainer: L.Trainer, prediction: Prediction) -> None:
    """Log the :func:`distributions` to TensorBoard."""
    loggers = [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
    for name, values in distributions(prediction).items() if loggers else ():
        for logger in loggers if len(values) else ():
            logger.experiment.add_histogram(f"values/{name}", values, trainer.global_step)


def _publish(trainer: L.Trainer, tag: str, picture: np.ndarray, file: str) -> None:
    """Write ``<run>/pictures/step_<step>/<file>.png`` and log it to loggers of pictures.

    Args:
        trainer: with the loggers, the folder of the run and the step.
        tag: name in the loggers.
        picture: [h, w, 3] uint8.
        file: name without suffix.
    """
    step = trainer.global_step
    save_png(picture, Path(trainer.default_root_dir) / "pictures" / f"step_{step:06d}" / f"{file}.png")
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(tag, picture, step, dataformats="HWC")
        elif isinstance(logger, WandbLogger):
            logger.log_image(tag, [picture])


def _show_clouds(trainer: L.Trainer, batch: Batch, prediction: Prediction, element: int, name: str) -> None:
    """Log the point clouds of an element to TensorBoard.

    Args:
        trainer: with the loggers and the step.
        batch: with the photographs.
        prediction: of the batch.
        element: of the batch.
        name: of its subject.
    """
    loggers = [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
    for kind, (positions, colors) in clouds(batch, prediction, element).items() if loggers else ():
        for logger in loggers:
            logger.experiment.add_mesh(
                f"{name}/{kind}",
                positions[None],
                (255 * colors[None]).byte(),
                config_dict=CLOUD_VIEW,
                global_step=trainer.global_step,
            )
