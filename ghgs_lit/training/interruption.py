"""A run that is asked to stop saves a checkpoint after its step and ends."""

import time
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from lightning.pytorch.callbacks import Checkpoint

from ghgs_lit.runs.signals import Interrupted, handle, handlers
from ghgs_lit.training.checkpoints import validates_now

#: Seconds within which a second signal is the same one: a terminal sends it to all processes, and these
#: hand it on.
_SAME = 1.0


class StopAtStep(Checkpoint):
    """On Ctrl-C or SIGTERM: finishes the step, and its validation, writes ``last.ckpt`` and stops.

    A second signal stops at once. Several processes stop after the same step. Lightning calls it after all
    other callbacks, because it is a ``Checkpoint`` and the last one: the checkpoint has their state.
    ``received``: number of the signal; 0 without one.
    """

    def __init__(self) -> None:
        self.received = 0
        self._since = 0.0
        self._step = 0
        self._saved = 0  # the signal, once the checkpoint is written
        self._before = handlers()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Replace Lightning's handlers, which stop without a checkpoint; at the end it restores all."""
        self._step = trainer.global_step
        handle(self._note, self._before)

    def _note(self, number: int) -> None:
        if self.received and time.monotonic() - self._since > _SAME:
            raise Interrupted(number)
        if not self.received:
            self.received, self._since = number, time.monotonic()
            print("stopping after this step; again: at once", flush=True)

    def on_train_batch_end(self, trainer: L.Trainer, *args: Any) -> None:
        """Save here, unless the step is not complete or a validation is due first."""
        # Between two parts of an accumulated step the gradients so far would be lost.
        if trainer.global_step == self._step:
            return
        self._step = trainer.global_step
        if not validates_now(trainer):
            self._save(trainer)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save after the validation of a step."""
        if not trainer.sanity_checking:
            self._save(trainer)

    def _save(self, trainer: L.Trainer) -> None:
        number = self.received
        if trainer.world_size > 1:
            mine = torch.tensor(number, device=trainer.strategy.root_device)
            number = int(trainer.strategy.reduce(mine, reduce_op="max"))
        if number:
            trainer.save_checkpoint(Path(trainer.default_root_dir) / "checkpoints" / "last.ckpt")
            self._saved = number

    def on_train_batch_start(self, *args: Any) -> None:
        """End once the numbers of the step are logged, which comes after all other hooks of the step."""
        if self._saved:
            raise Interrupted(self._saved)

    def on_train_epoch_end(self, *args: Any) -> None:
        """As above, where no batch follows."""
        self.on_train_batch_start()
