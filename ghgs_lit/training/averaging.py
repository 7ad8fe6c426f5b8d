"""An exponential average of the weights, by Lightning's callback."""

from typing import Annotated

import lightning.pytorch as L
from lightning.pytorch.callbacks import WeightAveraging
from pydantic import Field
from torch.optim.swa_utils import get_ema_multi_avg_fn

from ghgs_lit.config.options import Options


class AveragingOptions(Options):
    """An exponential average of all weights (EMA), those of a loss included: validations measure
    it, checkpoints hold it beside the weights that are trained, and it is the result of the run."""

    group = "callbacks.ema"
    decay: Annotated[float, Field(gt=0, lt=1)] = 0.999
    """Share of the average that each step keeps."""

    def build(self) -> "Averaging":
        """The callback."""
        return Averaging(self.decay)


class Averaging(WeightAveraging):
    """Lightning's average, on the device of the training, all weights of a type at once.

    Args:
        decay: share of the average in (0, 1) that each step keeps."""

    def __init__(self, decay: float):
        super().__init__(multi_avg_fn=get_ema_multi_avg_fn(decay))

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Copy the weights to where they will be trained."""
        self._device = trainer.strategy.root_device
        super().setup(trainer, pl_module, stage)
        if self._average_model is not None:  # a count on a GPU would make each step wait
            self._average_model.n_averaged = self._average_model.n_averaged.cpu()
