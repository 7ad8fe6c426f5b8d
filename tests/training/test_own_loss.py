"""A loss with trained weights from a plug-in: training, clipping, freezing, averaging and checkpoints all
include its weights."""

import shutil
import sys
from itertools import pairwise
from pathlib import Path

import lightning.pytorch as L
import pytest
import torch

from ghgs_lit.config import build, registry, run_of
from ghgs_lit.errors import InputError
from ghgs_lit.training import GHGSModule, Optimization
from ghgs_lit.training.checkpoints import AtomicCheckpointIO
from ghgs_lit.training.start import check_resume
from tests.helpers.models import config, load_model, make_model, predict
from tests.helpers.scenes import make_batch
from tests.helpers.training import Standin, StepData, flat_renderer

FILE = Path(__file__).parents[1] / "fixtures" / "own_loss.py"
NODE = {"kind": "balanced"}
TRAINED = {"losses.log_variance", "losses.mixing"}


@pytest.fixture(autouse=True)
def plugin(tmp_path, monkeypatch):
    """Register the user's file, as GHGS_PLUGINS does in a shell."""
    shutil.copy(FILE, tmp_path / "own_loss.py")
    registry.load_plugins()  # the distribution's plug-ins stay registered
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(registry, "_REGISTERED", dict(registry._REGISTERED))
    monkeypatch.setenv(registry.VARIABLE, str(tmp_path / "own_loss.py"))
    registry.load_plugins()
    yield
    sys.modules.pop("own_loss", None)


def module(model=None, settings=None, **options) -> GHGSModule:
    """A module with the user's loss and equal initial weights at each call."""
    torch.manual_seed(0)
    options = {"lr": 0.05, "warmup": 0.0, "weight_decay": 0.0, **options}
    losses = build(NODE, "loss")
    return GHGSModule(model or Standin(), flat_renderer, losses, Optimization(**options), settings)


def trainer(folder, steps, *callbacks, **options) -> L.Trainer:
    return L.Trainer(
        accelerator="cpu", max_steps=steps, max_epochs=-1, default_root_dir=folder, logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
        limit_val_batches=0, callbacks=list(callbacks), plugins=[AtomicCheckpointIO()], **options,
    )  # fmt: skip


def weights(subject) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in subject.state_dict().items()}


class Seen(L.Callback):
    """Records the weights after each step, and the norm of the gradient that the optimizer gets."""

    def __init__(self):
        self.weights, self.norms = [], []

    def on_before_zero_grad(self, run, pl_module, optimizer):
        slopes = [p.grad for p in pl_module.parameters() if p.grad is not None]
        if slopes:
            self.norms.append(float(torch.stack([slope.norm() for slope in slopes]).norm()))

    def on_train_batch_end(self, run, pl_module, *_):
        self.weights.append(weights(pl_module))


class Save(L.Callback):
    """Saves a checkpoint in the middle of a run."""

    def __init__(self, path, step):
        self.path, self.step = path, step

    def on_train_batch_end(self, run, *_):
        if run.global_step == self.step:
            run.save_checkpoint(self.path)


@pytest.mark.parametrize("scale", [None, 1.0])
def test_its_weights_move_in_each_step(tmp_path, scale):
    """AdamW and Muon train the loss's weights, except frozen ones."""
    subject, seen = module(matrix_scale=scale), Seen()
    before = weights(subject)
    trainer(tmp_path, 3, seen).fit(subject, StepData())
    for name in TRAINED:
        values = [before[name], *(step[name] for step in seen.weights)]
        assert not any(torch.equal(*pair) for pair in pairwise(values))
    assert torch.equal(seen.weights[-1]["losses.network.weight"], before["losses.network.weight"])


def test_the_norm_that_is_clipped_is_that_of_all_weights(tmp_path):
    """The joint norm of the gradients of model and loss is at most ``optimizer.clip``."""
    subject, seen = module(clip=1e-3), Seen()
    trainer(tmp_path, 2, seen).fit(subject, StepData())
    assert seen.norms[-1] == pytest.approx(1e-3, rel=1e-3)


def test_its_weights_can_be_frozen_for_a_share_of_the_run(tmp_path):
    """Prefixes are names in the checkpoint, for the model names within it; neither gradients nor weight
    decay change frozen weights, and an unknown prefix raises."""
    until = {"losses.mixing": 0.5, "shift": 0.5}
    subject, seen = module(freeze_until=until, weight_decay=0.1), Seen()
    before = weights(subject)
    trainer(tmp_path, 4, seen).fit(subject, StepData())
    for name, changes in (("losses.mixing", 2), ("model.shift", 2), ("losses.log_variance", 4)):
        assert sum(not torch.equal(step[name], before[name]) for step in seen.weights) == changes, name
    with pytest.raises(InputError, match=r"optimizer\.freeze_until\.losses\.other"):
        trainer(tmp_path, 2).fit(module(freeze_until={"losses.other": 0.5}), StepData())


def test_a_run_goes_on_with_them(tmp_path):
    """A resumed run continues with equal weights and averages of the optimizer, bit for bit; a loss without
    these weights is rejected by name."""
    path, whole, seen = tmp_path / "last.ckpt", module(matrix_scale=1.0), Seen()
    trainer(tmp_path, 6, Save(path, 3), seen).fit(whole, StepData())
    again = module(matrix_scale=1.0)
    settings = {"optimizer": {"kind": "adamw", "lr": 0.05, "matrix_scale": 1.0}}
    assert check_resume(path, again, settings)[0] == 3
    assert torch.equal(again.losses.mixing, seen.weights[2]["losses.mixing"])
    trainer(tmp_path, 6).fit(again, StepData(), ckpt_path=path)
    for name, value in weights(again).items():
        assert torch.equal(value, weights(whole)[name]), name
    other = GHGSModule(Standin(), flat_renderer, lambda *_: None, Optimization())
    with pytest.raises(InputError, match=r"last\.ckpt: losses\.log_variance: expected weights of model"):
        check_resume(path, other, settings)


def test_a_checkpoint_predicts_without_the_loss(tmp_path, monkeypatch):
    """A checkpoint restores the model alone if the loss is not registered."""
    settings = {**config(), "loss": NODE}
    subject = module(make_model(), settings)
    run = trainer(tmp_path, 1)
    run.strategy.connect(subject)
    run.save_checkpoint(tmp_path / "last.ckpt", weights_only=True)
    monkeypatch.delenv(registry.VARIABLE)
    registry._REGISTERED.pop(("loss", "balanced"))
    model = load_model(tmp_path / "last.ckpt")
    with torch.no_grad():
        assert len(predict(model, make_batch(1, 3, 28, 28)).gaussians) > 0


def test_terms_join_by_registration(tmp_path):
    """Registered terms, a function and a class, are minimised and logged together with built-in ones."""
    weights = {"edges": 0.5, "light": 2.0, "render_l1": 0.8, "render_ssim": 0.0, "chamfer": 0.0}
    losses = run_of("train", [f"loss.weights.{name}={value}" for name, value in weights.items()]).loss.build()
    subject = GHGSModule(Standin(), flat_renderer, losses, Optimization(lr=0.05))
    before = subject.model.shift.clone()
    run = trainer(tmp_path, 3)
    run.fit(subject, StepData())
    logged = {name.removeprefix("loss/"): float(value) for name, value in run.callback_metrics.items()}
    parts = {name: logged[name] for name in ("edges", "light", "render_l1")}
    assert min(parts.values()) > 0
    assert logged["total"] == pytest.approx(sum(weights[name] * part for name, part in parts.items()))
    assert losses.terms["light"].calls == 3
    assert not torch.equal(subject.model.shift, before)
    assert losses.reads_depths


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("edge=1", r"edge: expected one of chamfer, .*edges.*; found 'edge' \(did you mean edges\?\)"),
        ("edges=-1", r"edges: expected a number >= 0; found -1"),
        ("edges=much", r"edges: expected a number >= 0; found 'much'"),
    ],
)
def test_weights_of_terms_are_checked(override, message):
    with pytest.raises(InputError, match=rf"loss\.weights\.{message}"):
        run_of("train", [f"loss.weights.{override}"])
