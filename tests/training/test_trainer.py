"""Common options of Lightning's Trainer work (time, accumulation, processes, precisions), and
a seed reproduces losses bit for bit."""

import lightning.pytorch as L
import pytest
import torch
from torch.utils.data import DataLoader

from ghgs_lit.errors import InputError
from ghgs_lit.rendering import Renderer
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.callbacks import TrainingCost
from ghgs_lit.training.checkpoints import AtomicCheckpointIO, CheckpointOptions
from ghgs_lit.training.trainer import TrainerOptions
from tests.helpers.losses import losses_of
from tests.helpers.models import config, make_model
from tests.helpers.scenes import training_batch
from tests.helpers.training import Standin, StepData, flat_renderer

CONFIG = {"seed": 3, "resume": None, "init_from": None, "optimizer": {"lr": 0.05}}


class Seen(L.Callback):
    """Records a sum of the images of each step, and counts validated batches."""

    def __init__(self):
        self.trained, self.validated, self.steps = [], 0, []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self.trained.append(float(batch.images.sum()))

    def on_validation_batch_end(self, *_):
        self.validated += 1

    def on_validation_start(self, trainer, pl_module):
        self.steps.append(trainer.global_step)


def fit(folder, length=5, **options) -> tuple[L.Trainer, Seen]:
    """Train 6 steps with ``options``, in epochs of ``length`` batches."""
    seen = Seen()
    best = CheckpointOptions(filename="best", monitor="val/psnr").build()
    chosen = {"accelerator": "cpu", "max_steps": 6, "val_check_interval": 6, **options}
    trainer = TrainerOptions(**chosen).build(
        default_root_dir=str(folder),
        logger=False,
        plugins=[AtomicCheckpointIO()],
        callbacks=[seen, TrainingCost(), best],
        enable_progress_bar=False,
    )
    losses = losses_of({"render_l1": 1.0, "chamfer": 0.0, "depth": 0.0})
    module = GHGSModule(Standin(), flat_renderer, losses, Optimization(lr=0.05), CONFIG)
    trainer.fit(module, StepData(length))
    return trainer, seen


@pytest.mark.parametrize("accumulated", [1, 2])
def test_validations_are_counted_in_steps_of_the_optimizer(tmp_path, accumulated):
    options = {"accumulate_grad_batches": accumulated, "val_check_interval": 2}
    assert fit(tmp_path, length=4, **options)[1].steps == [2, 4, 6]


def test_a_training_ends_when_its_time_is_up(tmp_path):
    """Lightning ignores ``max_time`` next to a callback that is a Timer."""
    trainer, _ = fit(tmp_path, max_steps=-1, max_time={"seconds": 1}, limit_val_batches=0)
    assert trainer.global_step > 0


def test_options_of_lightning_reach_it(monkeypatch):
    """Options reach Lightning's Trainer, and several processes allow parameters without a gradient."""
    seen = []
    monkeypatch.setattr(L, "Trainer", lambda **arguments: seen.append(arguments))
    for options in (
        {"precision": "tf32"},
        {"num_nodes": 2},
        {"devices": (0, 1)},
        {"precision": "bf16-mixed", "devices": (1,)},
        {"accelerator": "cpu", "devices": (1,)},
    ):
        TrainerOptions(**options).build()
    assert [arguments.get("strategy", "auto") for arguments in seen] == [
        "auto", "ddp_find_unused_parameters_true", "ddp_find_unused_parameters_true", "auto", "auto"
    ]  # fmt: skip
    assert [arguments["num_nodes"] for arguments in seen] == [1, 2, 1, 1, 1]
    assert [seen[3]["devices"], seen[4]["devices"]] == [(1,), 1]  # a CPU has no list of devices
    assert [seen[0]["precision"], seen[3]["precision"]] == ["32-true", "bf16-mixed"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"precision": "bf16-true"}, "expected 32-true, tf32, bf16-mixed or 16-mixed; found 'bf16-true'"),
        ({"accelerator": "tpu"}, "accelerator: expected one of gpu, cpu, auto, cuda; found 'tpu'"),
        ({"accelerator": "cpu", "devices": -1}, "trainer: "),
    ],
)
def test_what_it_cannot_do_is_one_line(options, message):
    """Unsupported values raise a one-line error instead of Lightning's tracebacks."""
    with pytest.raises(InputError) as caught:
        TrainerOptions(**options).build()
    assert message in str(caught.value)


LOSSES = losses_of({"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 1.0, "depth": 1.0}, chamfer_points=20)


class Curve(L.Callback):
    def __init__(self):
        self.losses = []

    def on_train_batch_end(self, trainer, pl_module, outputs, *_):
        self.losses.append(outputs["loss"].item())


def curve_of(folder, workers: int, noise: int) -> tuple[list[float], torch.Tensor]:
    """Losses of a few steps of a real model, and its final weights."""
    model, curve = make_model(), Curve()
    batches = [training_batch(size=size) for size in (28, 42, 28)]
    data = DataLoader(batches, batch_size=None, collate_fn=lambda b: b, num_workers=workers)
    torch.manual_seed(noise)  # the state of the global generator must not matter
    module = GHGSModule(model, Renderer(backend="cpu"), LOSSES, Optimization(lr=1e-3), config() | {"seed": 5})
    trainer = L.Trainer(
        accelerator="cpu", max_steps=3, max_epochs=-1, default_root_dir=folder, callbacks=[curve],
        logger=False, enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
        deterministic=True,
    )  # fmt: skip
    trainer.fit(module, data)
    return curve.losses, torch.cat([p.detach().flatten() for p in model.parameters()])


@pytest.mark.filterwarnings("ignore:.*fork.*")
def test_a_curve_does_not_depend_on_the_number_of_loading_processes(tmp_path):
    """Losses and weights are bit-identical; that batches are, too, is tested with the data."""
    before = torch.are_deterministic_algorithms_enabled()
    try:
        losses, weights = curve_of(tmp_path, 0, noise=1)
        for workers in (0, 2):
            again, other = curve_of(tmp_path, workers, noise=2 + workers)
            assert again == losses
            assert torch.equal(weights, other)
    finally:
        torch.use_deterministic_algorithms(before)
    assert len(set(losses)) == 3
