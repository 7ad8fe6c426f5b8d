"""The same seed gives the same curve, bit for bit."""

import lightning.pytorch as L
import pytest
import torch
from torch.utils.data import DataLoader

from ghgs_lit.rendering import Renderer
from ghgs_lit.training import GHGSModule, Optimization
from tests.helpers.losses import losses_of
from tests.helpers.models import config, make_model
from tests.helpers.scenes import training_batch

LOSSES = losses_of({"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 1.0, "depth": 1.0}, chamfer_points=20)


class Curve(L.Callback):
    def __init__(self):
        self.losses = []

    def on_train_batch_end(self, trainer, pl_module, outputs, *_):
        self.losses.append(outputs["loss"].item())


def train(folder, workers: int, noise: int) -> tuple[list[float], torch.Tensor]:
    """Losses of some steps of a real model, and all its weights at the end."""
    model, curve = make_model(), Curve()
    batches = [training_batch(size=size) for size in (28, 42, 28)]
    data = DataLoader(batches, batch_size=None, collate_fn=lambda b: b, num_workers=workers)
    torch.manual_seed(noise)  # what the process drew before must not matter
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
    """Equal losses and weights in every bit;
    what a batch is for any number is tested with the data."""
    before = torch.are_deterministic_algorithms_enabled()
    try:
        losses, weights = train(tmp_path, 0, noise=1)
        for workers in (0, 2):
            again, other = train(tmp_path, workers, noise=2 + workers)
            assert again == losses
            assert torch.equal(weights, other)
    finally:
        torch.use_deterministic_algorithms(before)
    assert len(set(losses)) == 3
