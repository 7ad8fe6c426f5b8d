"""``ghgs pretext``: train the semantic branch of an encoder on built-in people."""

from pathlib import Path
from typing import Any

import lightning.pytorch as L
from lightning.pytorch.utilities import rank_zero_only

from ghgs_lit.cli.inputs import build_data
from ghgs_lit.cli.runtime import announce, output_dir, write_config
from ghgs_lit.cli.train import build_trainer, fit, resume_step, run_job, silence_lightning
from ghgs_lit.cli.verb import Training
from ghgs_lit.errors import require
from ghgs_lit.runs.run import RunDirectory
from ghgs_lit.training import loggers
from ghgs_lit.training.checkpoints import StopAtStep
from ghgs_lit.training.pretext import Pretext, PretextModule


def run(verb: Training) -> float | str | None:
    """Train the semantic branch.

    Returns:
        Part accuracy on validation people, 0 to 1; in a sweep ``job.BUSY`` if another process has locked
        the run.

    Raises:
        Interrupted: By Ctrl-C or SIGTERM.
    """
    return run_job(verb, RunDirectory(output_dir()), pretrain)


def pretrain(run: Training, directory: Path, stats: dict[str, Any]) -> float | None:
    """Train the branch and save it.

    Args:
        run: Configuration of the run.
        directory: Directory of the run.
        stats: Receives the ``steps`` and ``seconds`` of this training.

    Returns:
        Part accuracy on validation people, 0 to 1.

    Raises:
        InputError: The encoder has no semantic branch, or the image size is not a multiple of its patch
            size.
    """
    # Shown in tables as the origin of models that start from this checkpoint.
    run = run.with_changes(encoder={"weights": "pretext"})
    options = run.encoder.semantic
    patch_size = run.encoder.patch_size
    require(options is not None, "encoder.semantic", "the options of a branch to train", None)
    if rank_zero_only.rank == 0:
        write_config(run, directory)
    L.seed_everything(run.seed, workers=True, verbose=False)
    data = build_data(run)
    fits = not any(side % patch_size for side in data.dataset.size)
    require(fits, "data.size", f"sides divisible by the patch size {patch_size}", list(data.dataset.size))
    model = Pretext(options.build(patch_size))
    module = PretextModule(model, run.optimizer.build(), run.plain)
    step = resume_step(run, module)
    silence_lightning()
    trainer = build_trainer(run, directory, StopAtStep())
    try:
        fit(trainer, module, data, run.resume, step, stats)
        checkpoint = directory / "checkpoints" / "last.ckpt"
        trainer.save_checkpoint(checkpoint)
        accuracy = trainer.validate(module, data, verbose=False)[0]["val/part_accuracy"]
        if trainer.is_global_zero:
            print(f"the nearest patch of another view shows the same part: {accuracy:.1%}", flush=True)
            announce(checkpoint)
        return accuracy
    finally:
        loggers.close(trainer.loggers)
