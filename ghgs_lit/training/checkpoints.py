"""Atomic writing of checkpoints: at intervals, for the best validation, and when a signal stops a run."""

import os
import signal
import time
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any

import lightning.pytorch as L
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint, ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from pydantic import Field

from ghgs_lit.config.options import Index, Options, Text, name_type
from ghgs_lit.files import write_atomically
from ghgs_lit.runs.processes import handle, handlers, interrupt
from ghgs_lit.weights import frozen
from ghgs_lit.weights.reading import open_file


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints with :func:`ghgs_lit.files.write_atomically`, and frozen weights once, to a
    separate file (:mod:`ghgs_lit.weights.frozen`).

    Lightning's class writes to the system's temporary folder and moves the file. Between file systems
    this copies over the previous checkpoint, and a run killed meanwhile loses both."""

    def __init__(self) -> None:
        super().__init__()
        self._frozen = frozen.Frozen()

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike, storage_options: Any | None = None
    ) -> None:
        """Replace the checkpoint at ``path`` atomically; ``storage_options`` is not used."""
        content = self._frozen.stored(checkpoint, Path(path).absolute().parent)
        write_atomically(path, lambda temporary: torch.save(content, temporary))

    def load_checkpoint(
        self, path: str | os.PathLike, map_location: Any = "cpu", weights_only: bool | None = True
    ) -> dict[str, Any]:
        """Load a checkpoint together with its shared frozen weights. Only tensors, memory-mapped from
        disk, and plain data are read; ``map_location`` and ``weights_only`` are not used.

        Raises:
            InputError: the file is not a checkpoint, or its frozen weights are missing."""
        content = frozen.join_frozen(path, open_file(path))
        content["pytorch-lightning_version"] = L.__version__  # supported versions need no migration
        return content


def validates_now(trainer: L.Trainer) -> bool:
    """Whether a validation follows the present step; False if validations are not counted in steps.

    Args:
        trainer: the Trainer of a callback at the end of a step."""
    every = trainer.val_check_batch
    by_steps = trainer.check_val_every_n_epoch is None
    if not (by_steps and trainer.enable_validation and isinstance(every, int)):
        return False
    return (trainer.fit_loop.total_batch_idx + 1) % every == 0


class AfterSteps(Callback):
    """Calls ``after_step`` after each step of the optimizer, or after its validation if one is due.

    A checkpoint written before that validation would lose it, as a restart does not repeat it. One
    written between two batches of an accumulated step would lose the gradients so far."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Store the step at which the run starts."""
        super().on_train_start(trainer, pl_module)
        self._step = trainer.global_step

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """Call ``after_step`` at the end of a step without a validation."""
        is_whole = trainer.global_step > self._step
        self._step = trainer.global_step
        if is_whole and not validates_now(trainer):
            self.after_step(trainer, pl_module)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Call ``after_step`` after the validation of a step."""
        if not trainer.sanity_checking:
            self.after_step(trainer, pl_module)


#: File name with placeholders for logged values, as in Lightning; no value can lead out of the folder.
FileName = Annotated[
    str,
    Field(pattern=r"^([^/\\{}\x00-\x1f]|\{[\w/]+(:[\w.]*)?\})+$"),
    name_type("a name without folders, such as best or {step}"),
]


class CheckpointOptions(Options):
    """A checkpoint in ``<run>/checkpoints`` at intervals of steps or minutes, or of the best
    validation. List callbacks with a monitor before those without, so that the best checkpoint is
    selected first."""

    group = "callbacks.checkpoints"
    filename: FileName
    """Name of the file without .ckpt. With {step} all checkpoints are kept, unless monitor is set."""
    monitor: Text | None = None
    """Logged value by which each validation is compared, higher is better; null: none."""
    every_n_train_steps: Index | None = None
    """Steps between two checkpoints."""
    minutes: float | None = Field(None, gt=0, le=1e6)
    """Minutes between two checkpoints, in addition to every_n_train_steps."""

    def build(self) -> "Checkpoints":
        """Create the callback."""
        return Checkpoints(self)


class Checkpoints(AfterSteps, ModelCheckpoint):
    """Lightning's ModelCheckpoint in ``<run>/checkpoints``. A file replaces the previous one of the same
    name."""

    def __init__(self, options: CheckpointOptions):
        arguments = dict(options)
        minutes = arguments.pop("minutes")
        super().__init__(
            mode="max",
            save_top_k=-1 if options.monitor is None else 1,
            auto_insert_metric_name=False,
            enable_version_counter=False,
            save_on_train_epoch_end=False,
            **arguments,
        )
        if minutes is not None:  # Lightning's arguments allow only one interval, its hook handles both
            self._train_time_interval = timedelta(minutes=minutes)

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Set the folder to ``<run>/checkpoints``, unless it is already set."""
        self.dirpath = self.dirpath or str(Path(trainer.default_root_dir) / "checkpoints")
        super().setup(trainer, pl_module, stage)

    def after_step(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save a checkpoint if one is due."""
        ModelCheckpoint.on_train_batch_end(self, trainer, pl_module, None, None, 0)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save the best checkpoint, or one that is due at the step of this validation."""
        if self.monitor is not None:
            ModelCheckpoint.on_validation_end(self, trainer, pl_module)
        super().on_validation_end(trainer, pl_module)

    def state_dict(self) -> dict[str, Any]:
        """Lightning's state with file names in place of paths, so that the folder can be moved."""
        return _with_paths(super().state_dict(), lambda path: Path(path).name) | {"dirpath": ""}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore the state if all its best checkpoints are in this run's folder, otherwise start anew."""
        here = Path(self.dirpath)
        if all((here / Path(path).name).exists() for path in state_dict["best_k_models"]):
            state = _with_paths(state_dict, lambda path: str(here / Path(path).name))
            super().load_state_dict(state | {"dirpath": self.dirpath})


def _with_paths(state: dict[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """A copy of ModelCheckpoint's state with ``change`` applied to each path that is not empty."""
    names = ("best_model_path", "kth_best_model_path", "last_model_path")
    paths = {name: change(state[name]) if state[name] else "" for name in names}
    scores = {change(path): score for path, score in state["best_k_models"].items()}
    return {**state, **paths, "best_k_models": scores}


#: Seconds within which a repeated signal counts as the first one: a terminal sends it to all
#: processes, and these forward it.
_SAME = 1.0


class StopAtStep(AfterSteps, Checkpoint):
    """Stops a run on Ctrl-C or a signal of a batch system: finishes the step and its validation, writes
    ``last.ckpt``, and stops. The same signal again, or Ctrl-C, stops at once.

    All processes stop after the same step. Lightning calls callbacks of type ``Checkpoint`` last, so
    the checkpoint contains the state of all other callbacks.

    Attributes:
        received: number of the signal received; 0: none."""

    def __init__(self) -> None:
        self.received = 0
        self._since = 0.0
        self._saved = 0  # number of the signal, once the checkpoint is written
        self._before = handlers()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Replace Lightning's signal handlers, which save no checkpoint.
        Lightning restores all handlers at the end."""
        super().on_train_start(trainer, pl_module)
        handle(self._note, self._before)

    def _note(self, number: int) -> None:
        # SIGTERM after SIGUSR1 comes from a batch system that grants more time:
        # only the same signal or Ctrl-C means to stop at once.
        insists = number in (self.received, signal.SIGINT)
        if self.received and insists and time.monotonic() - self._since > _SAME:
            interrupt(number)
        if not self.received:
            self.received, self._since = number, time.monotonic()
            print("stopping after this step; again: at once", flush=True)

    def after_step(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Write ``last.ckpt`` if a process has received a signal."""
        number = self.received
        if trainer.world_size > 1:
            mine = torch.tensor(number, device=trainer.strategy.root_device)
            number = int(trainer.strategy.reduce(mine, reduce_op="max"))
        if number:
            trainer.save_checkpoint(Path(trainer.default_root_dir) / "checkpoints" / "last.ckpt")
            self._saved = number

    def on_train_batch_start(self, *args: Any) -> None:
        """Stop before the next batch: Lightning logs a step's values after all hooks of that step."""
        if self._saved:
            interrupt(self._saved)

    def on_train_epoch_end(self, *args: Any) -> None:
        """Stop at the end of an epoch, where no batch follows."""
        self.on_train_batch_start()
