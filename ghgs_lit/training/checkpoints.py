"""Checkpoints on disk: whole or not there at all, whatever kills the run."""

import os
import shutil
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any

import lightning.pytorch as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO

from ghgs_lit.errors import require

_PATHS = ("best_model_path", "kth_best_model_path", "last_model_path")


class WholeFiles(TorchCheckpointIO):
    """Writes a checkpoint beside its place, waits for the disk, then renames it.

    Lightning's own writes into the system's temporary folder and *moves*: across file systems that is a
    copy over the checkpoint before, and a run that is killed meanwhile has lost both.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike, storage_options: Any | None = None
    ) -> None:
        place = Path(path)
        place.parent.mkdir(parents=True, exist_ok=True)
        # One name for all attempts: what a killed run left is overwritten by the next.
        aside = place.with_name(f".{place.name}.tmp")
        with open(aside, "wb") as file:
            torch.save(checkpoint, file)
            file.flush()
            os.fsync(file.fileno())
        os.replace(aside, place)
        _sync_folder(place.parent)

    def load_checkpoint(
        self, path: str | os.PathLike, map_location: Any = "cpu", weights_only: bool | None = True
    ) -> dict[str, Any]:
        """Tensors and plain data only, whatever the version of PyTorch takes for the default."""
        return torch.load(path, map_location=map_location, weights_only=True)


def _sync_folder(folder: Path) -> None:
    """Let a rename survive a power cut as well; where folders cannot be opened there is nothing to do."""
    try:
        handle = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def _validates_now(trainer: L.Trainer) -> bool:
    """Whether validation follows this step, where validations are counted in steps."""
    every, by_steps = trainer.val_check_batch, trainer.check_val_every_n_epoch is None
    if not (by_steps and trainer.enable_validation and isinstance(every, int)):
        return False
    return (trainer.fit_loop.total_batch_idx + 1) % every == 0


class Checkpoints(ModelCheckpoint):
    """Lightning's ModelCheckpoint in ``<run>/checkpoints``; each file replaces the last of its name.

    ``minutes`` saves by the clock, as ``every_n_train_steps`` does by steps. Where a validation is due, the
    best is chosen first: list what is monitored before what is not.
    """

    def __init__(self, minutes: float | None = None, **kwargs):
        require(minutes is None or minutes > 0, "callbacks.minutes", "null or a positive number", minutes)
        interval = None if minutes is None else timedelta(minutes=minutes)
        super().__init__(
            auto_insert_metric_name=False,
            enable_version_counter=False,
            train_time_interval=interval,
            **kwargs,
        )

    def setup(self, trainer: L.Trainer, pl_module: L.LightningModule, stage: str) -> None:
        self.dirpath = self.dirpath or str(Path(trainer.default_root_dir) / "checkpoints")
        super().setup(trainer, pl_module, stage)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        super().on_train_start(trainer, pl_module)
        self._step = trainer.global_step

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: L.LightningModule, *args: Any) -> None:
        # Between two parts of an accumulated step the gradients so far would be lost.
        if trainer.global_step == self._step:
            return
        self._step = trainer.global_step
        # A restart does not catch up on a validation that was due when the checkpoint was written.
        if self.monitor is not None or not _validates_now(trainer):
            super().on_train_batch_end(trainer, pl_module, *args)

    def on_validation_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if self.monitor is not None:
            super().on_validation_end(trainer, pl_module)
        elif not trainer.sanity_checking:
            super().on_train_batch_end(trainer, pl_module, None, None, 0)

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on with the best so far, also where the run goes on in another folder."""
        state = dict(state_dict)
        if state.get("dirpath") not in (None, self.dirpath):
            state = self._moved(state)
        if all(Path(path).exists() for path in state["best_k_models"]):
            super().load_state_dict(state)

    def _moved(self, state: Mapping[str, Any]) -> dict[str, Any]:
        """``state`` with the paths of this folder; the best files are copied to it."""
        folder = Path(self.dirpath)

        def here(path: str) -> str:
            return str(folder / Path(path).name) if path else path

        for path in map(Path, state["best_k_models"]):
            target = folder / path.name
            if path.exists() and not target.exists():
                folder.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target.with_name(f".{target.name}.tmp"))
                os.replace(target.with_name(f".{target.name}.tmp"), target)
        moved = {name: here(state.get(name, "")) for name in _PATHS}
        best = {here(path): score for path, score in state["best_k_models"].items()}
        return {**state, **moved, "best_k_models": best, "dirpath": self.dirpath}
