"""The LightningModule, its schedule, checkpoints and callbacks, with a stand-in model."""

import dataclasses
from datetime import timedelta
from types import SimpleNamespace

import lightning.pytorch as L
import pytest
import torch
from lightning.pytorch.callbacks import Timer
from lightning.pytorch.plugins.precision import MixedPrecision
from torch.utils.data import DataLoader

from ghgs_lit.errors import InputError
from ghgs_lit.geometry.precision import exact
from ghgs_lit.metrics.functional import psnr, ssim
from ghgs_lit.metrics.regions import box_of
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.checkpoints import CheckpointOptions
from ghgs_lit.training.trainer import TrainerOptions
from ghgs_lit.types import DepthMaps, Targets
from ghgs_lit.weights.checkpoint import FORMAT_VERSION
from tests.helpers.losses import losses_of
from tests.helpers.models import load_model, make_model
from tests.helpers.scenes import make_batch
from tests.helpers.training import (
    CONFIG,
    Standin,
    example_batch,
    flat_renderer,
    loader,
    module,
    trainer,
)

RELEASE = Optimization(lr=1e-4, warmup=0.01, end_factor=5e-4)


@pytest.mark.parametrize(("step", "rate"), [(0, 4e-6), (2000, 1e-4), (100_000, 5.05e-5), (200_000, 5.0e-8)])
def test_the_release_schedule_is_the_authors(step, rate):
    """Learning rates of the published training: initial, highest, half-way, final."""
    assert RELEASE.lr * RELEASE.factor(step / 200_000) == pytest.approx(rate, rel=2e-3)


def test_the_schedule_stays_at_its_end():
    """A budget exceeded by one step must not give a negative learning rate."""
    assert RELEASE.factor(1.5) == pytest.approx(RELEASE.end_factor)
    assert Optimization(lr=1.0, warmup=0.0, end_factor=0.0).factor(0.0) == 1


def test_progress_is_the_further_of_steps_and_time(monkeypatch):
    """The schedule ends when the budget of steps or of time ends, whichever is first."""
    timer = Timer(duration=timedelta(seconds=100))
    used = {"seconds": 0.0}
    monkeypatch.setattr(timer, "time_elapsed", lambda *_: used["seconds"])
    subject = module()
    subject._trainer = SimpleNamespace(global_step=30, max_steps=100, callbacks=[timer], world_size=1)
    monkeypatch.setattr(GHGSModule, "global_step", property(lambda self: self._trainer.global_step))
    assert subject.progress() == pytest.approx(0.3)
    used["seconds"] = 60.0
    assert subject.progress() == pytest.approx(0.6)
    used["seconds"] = 500.0
    assert subject.progress() == 1
    subject._trainer.max_steps = -1
    used["seconds"] = 25.0
    assert subject.progress() == pytest.approx(0.25)
    subject._trainer.callbacks = []
    with pytest.raises(InputError, match=r"trainer\.max_steps"):
        subject.progress()


def test_training_lowers_the_loss_and_ends_with_no_rate(tmp_path):
    """The gradient reaches the model through renderer and losses,
    and the schedule reaches its end."""
    torch.manual_seed(0)
    subject, batch = module(), example_batch()
    before = subject.losses(*subject(batch), batch)[0].item()
    run = trainer(tmp_path, steps=25)
    run.fit(subject, loader(1))
    assert subject.losses(*subject(batch), batch)[0].item() < 0.8 * before
    assert run.optimizers[0].param_groups[0]["lr"] == pytest.approx(0, abs=1e-12)
    assert subject.used_budget == 1


def test_checkpoints_are_plain(tmp_path):
    """Checkpoints load with weights_only=True and contain the configuration."""
    last = CheckpointOptions(filename="last", every_n_train_steps=3).build()
    best = CheckpointOptions(filename="best", monitor="val/psnr").build()
    trainer(tmp_path, steps=12, callbacks=[last, best]).fit(module(), loader(), loader(1))
    files = sorted(p.name for p in (tmp_path / "checkpoints").iterdir())
    assert files == ["best.ckpt", "last.ckpt"]
    content = torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)
    assert content["config"] == CONFIG
    assert content["format_version"] == FORMAT_VERSION
    assert content["global_step"] == 12
    assert set(content["state_dict"]) == {"model.depth", "model.shift"}
    assert "hyper_parameters" not in content


def test_a_scaled_loss_is_unscaled_before_the_gradient_is_clipped(tmp_path):
    """With 16-mixed the norm that is clipped and logged is that of the unscaled loss."""

    class Norms(L.Callback):
        def on_train_batch_end(self, trainer, *_):
            norms.append(float(trainer.callback_metrics["train/gradient_norm"]))

    seen = []
    for scale in (1.0, 4096.0):
        seen.append(norms := [])
        scaler = torch.amp.GradScaler("cpu", init_scale=scale)
        options = Optimization(lr=0.1, clip=0.5)
        subject = GHGSModule(Standin(), flat_renderer, losses_of({"depth": 1.0}), options, CONFIG)
        plugins = [MixedPrecision("16-mixed", "cpu", scaler)]
        trainer(tmp_path, 3, [Norms()], plugins=plugins).fit(subject, loader(1))
    assert seen[1] == pytest.approx(seen[0], rel=1e-3)
    assert len(seen[1]) == 3
    assert not subject.optimizers().optimizer.defaults["fused"]


def test_tf32_is_for_networks_alone():
    """``trainer.precision=tf32`` rounds products of networks but not of geometry, which restores the
    setting afterwards."""
    matmul = torch.backends.cuda.matmul
    try:
        trainer = TrainerOptions(accelerator="cpu", precision="tf32", max_steps=1).build(logger=False)
        assert trainer.precision == "32-true"
        assert matmul.fp32_precision == "tf32"
        with exact("cpu"), torch.autocast("cpu"), exact("cpu"):
            assert matmul.fp32_precision == "ieee"
            assert not torch.is_autocast_enabled("cpu")
        with pytest.raises(KeyError), exact("cpu"):
            raise KeyError
        assert matmul.fp32_precision == "tf32"
    finally:
        torch.set_float32_matmul_precision("highest")


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"filename": "last", "minutes": 0}, r"callbacks\.checkpoints\.minutes"),
        ({"filename": "last", "minutes": -1.0}, r"callbacks\.checkpoints\.minutes"),
        ({"lr": 0.0}, r"optimizer\.lr"),
        ({"lr": 1.0, "matrix_scale": 0.0}, r"optimizer\.matrix_scale"),
        ({"lr": 1.0, "betas": [0.9, 1.0]}, r"optimizer\.betas"),
        ({"lr": 1.0, "warmup": 1.0}, r"optimizer\.warmup"),
        ({"lr": 1.0, "clip": 0.0}, r"optimizer\.clip"),
        ({"lr": 1.0, "end_factor": 2.0}, r"optimizer\.end_factor"),
        ({"lr": 1.0, "freeze_until": {"head": 2.0}}, r"optimizer\.freeze_until: expected .*'head': 2"),
        ({"lr": 1.0, "skip_nonfinite": -1}, r"optimizer\.skip_nonfinite"),
    ],
)
def test_impossible_values_name_their_key(values, key):
    """Impossible values fail when they are read, with their key."""
    options = CheckpointOptions if "filename" in values else Optimization
    with pytest.raises(InputError, match=key):
        options(**values)


def test_random_numbers_of_a_step_are_those_of_seed_step_and_part(monkeypatch):
    """Random numbers depend on these three only, so that all processes sample the same."""
    monkeypatch.setattr(GHGSModule, "global_step", property(lambda self: self._trainer.global_step))
    monkeypatch.setattr(GHGSModule, "global_rank", property(lambda self: self._trainer.global_rank))

    def seed(seed=1, step=7, part=0, rank=0):
        subject = module()
        subject.config = {**CONFIG, "seed": seed}
        subject._trainer = SimpleNamespace(global_step=step, global_rank=rank, accumulate_grad_batches=2)
        torch.manual_seed(int(torch.randint(1000, ())))
        return subject.step_seed(4 + part)

    different = [seed(), seed(seed=2), seed(step=8), seed(part=1)]
    assert len(set(different)) == 4
    assert different == [seed(rank=1), seed(seed=2), seed(step=8), seed(part=1)]


def test_a_trainer_of_ones_own_needs_no_configuration(tmp_path):
    """The checkpoint of a custom Trainer is enough to rebuild the model."""
    parts = {"losses": losses_of({"render_l1": 1.0}), "optimization": Optimization(lr=1e-3)}
    subject = GHGSModule(make_model(), flat_renderer, **parts)
    batch = make_batch(1, 3, 42, 42)
    photographs = Targets(batch.images[:, :1], batch.masks[:, :1], batch.cameras[:, :1])
    batches = DataLoader([dataclasses.replace(batch, targets=photographs)], None, collate_fn=lambda b: b)
    run = trainer(tmp_path, steps=1)
    run.fit(subject, batches)
    run.save_checkpoint(tmp_path / "mine.ckpt")
    model = load_model(tmp_path / "mine.ckpt")
    for name, value in subject.model.state_dict().items():
        assert torch.equal(model.state_dict()[name], value), name


def test_validation_measures_clamped_renders(tmp_path):
    """PSNR and SSIM are measured on clamped images, as by `ghgs evaluate`."""

    def brighter(gaussians, cameras, by=3.0):
        drawn = flat_renderer(gaussians, cameras)
        pattern = torch.linspace(-1, by, drawn.image.shape[-1])
        return dataclasses.replace(drawn, image=drawn.image + pattern)

    subject, batch = module(brighter), example_batch()
    run = trainer(tmp_path, steps=1)
    (found,) = run.validate(
        subject, DataLoader([batch], batch_size=None, collate_fn=lambda b: b), verbose=False
    )
    image = subject(batch)[1].image.detach().clamp(0, 1).flatten(0, 1)
    target = batch.targets.images.flatten(0, 1)
    assert found["val/ssim"] == pytest.approx(float(ssim(image, target, "reflect").mean()), rel=1e-4)
    assert found["val/psnr"] == pytest.approx(float(psnr(image, target).mean()), rel=1e-4)
    box = box_of(batch.targets.masks.flatten(0, 1))
    assert found["val/psnr_box"] == pytest.approx(float(psnr(image, target, box).mean()), rel=1e-4)


def test_depth_error_is_of_pixels_with_a_prediction(tmp_path):
    """Pixels whose depth the model marks as invalid are ignored."""

    class Half(Standin):
        def forward(self, batch):
            found = super().forward(batch)
            valid = batch.masks & (torch.arange(batch.masks.shape[-1]) < 8)
            depth = torch.where(valid, 2.15, 9.0)
            return dataclasses.replace(found, depth_maps=DepthMaps(depth, valid, torch.ones_like(depth)))

    subject = GHGSModule(Half(), flat_renderer, losses_of({"render_l1": 1.0}), Optimization(lr=0.05), CONFIG)
    (found,) = trainer(tmp_path, steps=1).validate(subject, loader(1), verbose=False)
    assert found["val/depth_error_mm"] == pytest.approx(50, abs=0.01)  # the truth is 2.1 m
