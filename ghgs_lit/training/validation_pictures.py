"""Validation pictures and point clouds of the first subjects."""

from pathlib import Path
from typing import Any

import lightning.pytorch as L
import numpy as np
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from ghgs_lit.config.options import Index, Options
from ghgs_lit.types import Batch, Prediction
from ghgs_lit.visualization.pictures import clouds, save_png, sheet

#: TensorBoard's view of point clouds: points of two centimetres in a perspective camera.
CLOUD_VIEW = {
    "camera": {"cls": "PerspectiveCamera", "fov": 40},
    "material": {"cls": "PointsMaterial", "size": 0.02},
}


class PicturesOptions(Options):
    """Pictures of the first subjects of each validation; of the first one also its point clouds."""

    group = "callbacks.pictures"
    subjects: Index = 2
    """Number of subjects; 0: none."""

    def build(self) -> "Pictures":
        """Create the callback."""
        return Pictures(self)


class Pictures(Callback):
    """Logs pictures of validation subjects, and writes them to ``<run>/pictures``.

    * ``view/sheet/<subject>``: inputs, depths, targets, renderings and errors;
    * ``values/*``, in TensorBoard's tabs of distributions: values of all Gaussians;
    * ``<subject>/points``, in its mesh tab: the predicted points and the body's vertices."""

    def __init__(self, options: PicturesOptions):
        self.options = options

    def on_validation_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Begin with the first subject."""
        self._number = 0

    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: dict[str, Any],
        batch: Batch,
        *args: Any,
    ) -> None:
        """Log the subjects of a batch, up to the configured number.

        Args:
            outputs: result of :meth:`ghgs_lit.training.module.GHGSModule.validation_step`."""
        prediction = outputs["prediction"]
        image = outputs["rendering"].image
        count = min(self.options.subjects - self._number, len(batch.images))
        for element in range(count if trainer.is_global_zero else 0):
            name = batch.subjects[element] if batch.subjects else f"subject_{self._number}"
            picture = sheet(batch, image, element, prediction.depth, prediction.depth_valid)
            _publish(trainer, f"view/sheet/{name}", picture, name)
            if self._number == 0:
                for logger in trainer.loggers:
                    if isinstance(logger, TensorBoardLogger):
                        _log_values(logger.experiment, batch, prediction, name, trainer.global_step)
            self._number += 1


def distributions(prediction: Prediction) -> dict[str, Tensor]:
    """Values of all Gaussians of a prediction, for histograms.

    Returns:
        Finite values by name: opacities, standard deviations in millimetres and, if their pixels are
        known, the distances from these pixels' points, in millimetres."""
    gaussians = prediction.gaussians
    known = {"opacity": gaussians.opacities, "scale_mm": 1000 * gaussians.scales}
    if gaussians.pixel is not None:
        points = prediction.points.pixels.flatten(0, 1).flatten(1, 2)[gaussians.image, gaussians.pixel]
        known["offset_mm"] = 1000 * (gaussians.means - points).norm(dim=-1)
    return {name: values[values.isfinite()] for name, values in known.items()}


def _log_values(writer: SummaryWriter, batch: Batch, prediction: Prediction, name: str, step: int) -> None:
    """Log :func:`distributions`, and the point clouds of the first subject, to TensorBoard."""
    for kind, values in distributions(prediction).items():
        if len(values):
            writer.add_histogram(f"values/{kind}", values, step)
    for kind, (positions, colors) in clouds(batch, prediction, 0).items():
        colors = (255 * colors[None]).byte()
        writer.add_mesh(f"{name}/{kind}", positions[None], colors, config_dict=CLOUD_VIEW, global_step=step)


def _publish(trainer: L.Trainer, tag: str, picture: np.ndarray, file: str) -> None:
    """Write a picture [h, w, 3] uint8 to ``<run>/pictures/step_<step>/<file>.png``, and log it under
    ``tag``."""
    step = trainer.global_step
    save_png(picture, Path(trainer.default_root_dir) / "pictures" / f"step_{step:06d}" / f"{file}.png")
    for logger in trainer.loggers:
        if isinstance(logger, TensorBoardLogger):
            logger.experiment.add_image(tag, picture, step, dataformats="HWC")
        elif isinstance(logger, WandbLogger):
            logger.log_image(tag, [picture])
