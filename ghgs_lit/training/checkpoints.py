"""Checkpoints, written atomically, also when a run is killed or stopped by a signal."""

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

from ghgs_lit.config.options import Index, Options, Text, Words
from ghgs_lit.files import write_atomically
from ghgs_lit.runs.processes import handle, handlers, interrupt
from ghgs_lit.weights import frozen
from ghgs_lit.weights.reading import open_file


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints by :func:`ghgs_lit.files.write_atomically`. Lightning's own class writes
    to the system's temporary folder and *moves* the file: between file systems that copies over the
    previous checkpoint, and a run killed meanwhile has lost both. Weights that are not trained are
    written once, to another file (:mod:`ghgs_lit.weights.frozen`)."""

    def __init__(self) -> None:
        super().__init__()
        self._frozen = frozen.Frozen()

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike, storage_options: Any | None = None
    ) -> None:
        """Replace a file atomically.

        Args:
            checkpoint: the content.
            path: the file.
            storage_options: not used."""
        content = self._frozen.stored(checkpoint, Path(path).absolute().parent)
        write_atomically(path, lambda temporary: torch.save(content, temporary))

    def load_checkpoint(
        self, path: str | os.PathLike, map_location: Any = "cpu", weights_only: bool | None = True
    ) -> dict[str, Any]:
        """Load tensors, mapped from the disk, and plain data only.

        Args:
            path: the file.
            map_location: not used.
            weights_only: not used.

        Returns:
            The content, with the frozen weights that the checkpoint shares.

        Raises:
            InputError: the file is no checkpoint, or its frozen weights are missing."""
        content = frozen.joined(path, open_file(path))
        content["pytorch-lightning_version"] = L.__version__  # supported ones need no migration
        return content


def validates_now(trainer: L.Trainer) -> bool:
    """Whether a validation follows this step, if validations are counted in steps.

    Args:
        trainer: in a callback at the end of a step."""
    every = trainer.val_check_batch
    by_steps = trainer.check_val_every_n_epoch is None
    if not (by_steps and trainer.enable_validation and isinstance(every, int)):
        return False
    return (trainer.fit_loop.total_batch_idx + 1) % every == 0


class AfterSteps(Callback):
    """Calls ``after_step`` after each step of the optimizer, or after its validation if one is due: a
    restart would not repeat it. Between two parts of an accumulated step the gradients so far would
    be lost."""

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Store the step at which the run starts."""
        super().on_train_start(trainer, pl_module)
        self._step = trainer.global_step

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        """After a part of a step."""
        is_whole = trainer.global_step > self._step
        self._step = trainer.global_step
        if is_whole and not validates_now(trainer):
            self.after_step(trainer, pl_module)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """After the validation of a step."""
        if not trainer.sanity_checking:
            self.after_step(trainer, pl_module)


#: A name in which Lightning fills in logged values, and which leaves its folder by none of them.
FileName = Annotated[
    str,
    Field(pattern=r"^([^/\\{}\x00-\x1f]|\{[\w/]+(:[\w.]*)?\})+$"),
    Words("a name without folders, such as best or {step}"),
]


class CheckpointOptions(Options):
    """A checkpoint in ``<run>/checkpoints`` at intervals of steps or minutes, or of the best
    validation. List callbacks with a monitor before those without, so that the best checkpoint is
    chosen first."""

    group = "callbacks.checkpoints"
    filename: FileName
    """Name of the file, without .ckpt; with {step} in it all are kept,
    unless there is a monitor."""
    monitor: Text | None = None
    """Logged value that is compared at each validation, the higher the better; null: none."""
    every_n_train_steps: Index | None = None
    """Steps between two checkpoints."""
    minutes: float | None = Field(None, gt=0, le=1e6)
    """Minutes between two checkpoints, in addition to every_n_train_steps."""

    def build(self) -> "Checkpoints":
        """The callback."""
        return Checkpoints(self)


class Checkpoints(AfterSteps, ModelCheckpoint):
    """Lightning's ModelCheckpoint in ``<run>/checkpoints``;
    a file replaces the previous one of its name.

    Args:
        options: names and intervals."""

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
        if minutes is not None:  # Lightning's arguments allow steps or time, its hook handles both
            self._train_time_interval = timedelta(minutes=minutes)

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        """Set the folder to ``<run>/checkpoints``, unless there is one."""
        self.dirpath = self.dirpath or str(Path(trainer.default_root_dir) / "checkpoints")
        super().setup(trainer, pl_module, stage)

    def after_step(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save if it is due."""
        ModelCheckpoint.on_train_batch_end(self, trainer, pl_module, None, None, 0)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Save the best checkpoint, or one that was due at the step of this validation."""
        if self.monitor is not None:
            ModelCheckpoint.on_validation_end(self, trainer, pl_module)
        super().on_validation_end(trainer, pl_module)

    def state_dict(self) -> dict[str, Any]:
        """Lightning's state with names of files in place of their paths,
        so that the folder can be moved."""
        return _with_paths(super().state_dict(), lambda path: Path(path).name) | {"dirpath": ""}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue with the best checkpoint so far, unless it is not in this run's folder."""
        here = Path(self.dirpath)
        if all((here / Path(path).name).exists() for path in state_dict["best_k_models"]):
            state = _with_paths(state_dict, lambda path: str(here / Path(path).name))
            super().load_state_dict(state | {"dirpath": self.dirpath})


def _with_paths(state: dict[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """A state of ModelCheckpoint in which each path that is not empty is changed."""
    names = ("best_model_path", "kth_best_model_path", "last_model_path")
    paths = {name: change(state[name]) if state[name] else "" for name in names}
    scores = {change(path): score for path, score in state["best_k_models"].items()}
    return {**state, **paths, "best_k_models": scores}


#: Seconds within which a second signal counts as the same one: a terminal sends it to all
#: processes, which forward it.
_SAME = 1.0


class StopAtStep(AfterSteps, Checkpoint):
    """On Ctrl-C or a signal of a batch system: finishes the step and its validation, writes
    ``last.ckpt`` and stops. The same signal again, or Ctrl-C, stops at once. Several processes stop
    after the same step. As the last ``Checkpoint``, Lightning calls it after all other callbacks,
    whose state is saved.

    Attributes:
        received: number of the signal; 0: none."""

    def __init__(self) -> None:
        self.received = 0
        self._since = 0.0
        self._saved = 0  # the signal, once the checkpoint is written
        self._before = handlers()

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Replace Lightning's signal handlers, which save no checkpoint;
        it restores all at the end."""
        super().on_train_start(trainer, pl_module)
        handle(self._note, self._before)

    def _note(self, number: int) -> None:
        """Handle a signal."""
        # SIGTERM after SIGUSR1 comes from a batch system that waits,
        # not from somebody who does not.
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
        """Stop here, since the values of a step are logged after all its other hooks."""
        if self._saved:
            interrupt(self._saved)

    def on_train_epoch_end(self, *args: Any) -> None:
        """Stop here if no batch follows."""
        self.on_train_batch_start()
