"""Captured training steps, on the pretend device with a stand-in for CUDA graphs."""

import dataclasses

import lightning.pytorch as L
import pytest
import torch
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch.utils.data import DataLoader

from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.execution import Predictor, step
from ghgs_lit.execution.graphs import GraphCache
from ghgs_lit.execution.step import CapturedStep
from ghgs_lit.rendering import capacity
from ghgs_lit.rendering.api import Renderer
from ghgs_lit.training import GHGSModule, Optimization
from tests.helpers.capture_backends import OperatorBackend, SilentBackend
from tests.helpers.losses import losses_of
from tests.helpers.models import make_model
from tests.helpers.pretend_device import DEVICE
from tests.test_device import PretendAccelerator

LOSSES = losses_of({"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 0.0, "depth": 0.2})
PAPER = losses_of({"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 1.0})


pytestmark = pytest.mark.usefixtures("there")


def training(*overrides):
    """A model in training mode, with two rounds if it has any."""
    two = ("rounds.training_counts=[2]",) * ("model=recurrent" in overrides)
    return make_model(*overrides, *two).to(DEVICE).train()


def make_step(model, losses=LOSSES, backend=OperatorBackend, capture="auto"):
    """The captured step of a model."""
    predictor = Predictor(model)
    predictor.options = predictor.options.replace(capture=capture)
    return with_backend(CapturedStep(predictor, Renderer(), losses), backend)


def with_backend(captured, backend):
    """Set a stand-in for CUDA graphs."""
    captured.predictor.graphs = GraphCache(limit=16, backend=backend())
    captured.graphs = GraphCache(limit=16, backend=backend())
    return captured


def scene(size=1, color=1.0, holes=0, side=28):
    batch = ellipsoid_batch(0.15, 3, side, size)
    batch.masks[0, 0, side // 2, 14 : 14 + holes] = False
    names = tuple(f"subject {holes} {number}" for number in range(size))
    batch = dataclasses.replace(batch, images=color * batch.images, subjects=names)
    bodies = [torch.linspace(-0.3, 0.3, 3 * 40).view(40, 3).roll(n, 1) for n in range(size)]
    return dataclasses.replace(batch, depths=2.0 * batch.masks, body_vertices=bodies).to(DEVICE)


def gradients_of(model, total):
    """Gradients of a loss by the names of weights, on the CPU."""
    model.zero_grad()
    total.backward()
    named = [(name, weight.grad) for name, weight in model.named_parameters()]
    return {name: slope.cpu() for name, slope in named if slope is not None}


def call_eagerly(model, batch, losses=LOSSES):
    """The loss and its terms, computed eagerly."""
    prediction = Predictor(model)(batch)
    rendering = Renderer()(prediction.gaussians, batch.targets.cameras)
    return *losses(prediction, rendering, batch), len(prediction.gaussians)


@pytest.mark.parametrize(
    ("kind", "size", "losses", "side"),
    [
        (["model=paper"], 1, LOSSES, 28),
        (["model=paper"], 2, PAPER, 28),
        (["model=recurrent"], 2, LOSSES, 28),
        (["model=paper", "model.pad=multiple"], 1, LOSSES, 24),
    ],
)
def test_losses_and_gradients_are_those_of_a_step_that_is_called(kind, size, losses, side):
    """For other batches of a shape bucket, also with gradient accumulation and padded views."""
    model = training(*kind)
    captured = make_step(model, losses)
    for holes, color in ((0, 1.0), (1, 0.9), (2, 0.8)):
        batch = scene(size, color, holes, side)
        total, values, gaussians = call_eagerly(model, batch, losses)
        wanted = gradients_of(model, total / 2)
        found = captured(batch)
        assert found.gaussians == gaussians
        torch.testing.assert_close(found.total.detach().cpu(), total.detach().cpu(), rtol=1e-6, atol=0)
        assert {name: float(value.cpu()) for name, value in found.values.items()} == pytest.approx(
            {name: float(value.detach().cpu()) for name, value in values.items()}, rel=1e-6
        )
        slope = gradients_of(model, found.total / 2)
        assert slope.keys() == wanted.keys()
        for name in wanted:
            assert (slope[name] - wanted[name]).abs().max() <= 1e-5 * wanted[name].abs().max(), name
    assert dict(captured.graphs.counts) == {"eager": 1, "captured": 1, "replayed": 1}


def test_a_factor_of_the_loss_changes_no_gradient():
    """For a constant or changing factor, gradients equal those of an eager step."""
    model, batch = training("model=paper"), scene()
    captured = make_step(model)
    wanted = gradients_of(model, call_eagerly(model, batch)[0])
    for exponent in (10, 16, 12):
        scale = torch.full((), 2.0**exponent, device=DEVICE)
        found = captured(batch, scale)
        slope = gradients_of(model, found.total * scale)
        for name in wanted:
            wrong = (slope[name] / 2.0**exponent - wanted[name]).abs().max()
            assert wrong <= 1e-5 * wanted[name].abs().max(), name
    assert dict(captured.graphs.counts) == {"eager": 1, "captured": 1, "replayed": 1}


def test_gradients_of_float16_do_not_underflow():
    """2^-26 is 0 in float16, but its multiple is not."""
    weight = torch.ones(4, requires_grad=True)
    total = ((weight.half() * 2.0**-14).sum() * 2.0**-12).float()
    assert step._differentiate(total, [weight], None)[0].abs().max() == 0
    total = ((weight.half() * 2.0**-14).sum() * 2.0**-12).float()
    (slope,) = step._differentiate(total, [weight], torch.tensor(2.0**10))
    assert torch.equal(slope, torch.full((4,), 2.0**-26))


def train(folder, capture):
    """Weights after four steps of two batches each, and the number of replays."""
    model = training("model=hull")
    module = GHGSModule(model, Renderer(), LOSSES, Optimization(lr=1e-2, warmup=0.0))
    captured = with_backend(module.captured_step, OperatorBackend)
    captured.predictor.options = captured.predictor.options.replace(capture=capture)
    batches = [scene(color=1 - number / 20, holes=number).to("cpu") for number in range(4)]
    trainer = L.Trainer(
        strategy=SingleDeviceStrategy(DEVICE, PretendAccelerator()), max_steps=4, accumulate_grad_batches=2,
        limit_val_batches=0, default_root_dir=folder, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module, DataLoader(batches, batch_size=None, collate_fn=lambda batch: batch))
    weights = {name: weight.detach().cpu() for name, weight in model.named_parameters()}
    return weights, captured.graphs.counts["replayed"]


def test_a_training_comes_to_the_same_weights(tmp_path):
    """With Lightning's loop, gradient accumulation and clipping."""
    (wanted, none), (found, replayed) = (train(tmp_path, capture) for capture in ("off", "auto"))
    assert (none, replayed) == (0, 6)
    for name in wanted:
        torch.testing.assert_close(found[name], wanted[name], rtol=1e-4, atol=1e-5, msg=name)


class LaunchCounter(L.Callback):
    """Counts launches and synchronisations of each training step, with optimizer, weight average and
    logging."""

    def __init__(self, log):
        self.launch_log, self.counts = log, []

    def on_train_batch_start(self, *_):
        self.launch_log.clear()

    def on_train_batch_end(self, *_):
        self.counts.append((self.launch_log.launches, self.launch_log.waits.total()))


def test_a_step_of_a_training_launches_few_kernels(there, tmp_path, monkeypatch):
    """In Lightning's loop, with synchronisations only for the plan, the capacity of renderings, and the
    guard."""
    model, counter = training("model=hull"), LaunchCounter(there)
    module = GHGSModule(model, Renderer(), LOSSES, Optimization(lr=1e-2, matrix_scale=1.0))
    with_backend(module.captured_step, SilentBackend)
    configured = module.configure_optimizers

    def configure_with_graphs():
        configuration = configured()
        configuration["optimizer"].graphs = GraphCache(backend=SilentBackend())
        return configuration

    monkeypatch.setattr(module, "configure_optimizers", configure_with_graphs)
    batches = [scene(color=1 - number / 20).to("cpu") for number in range(5)]
    trainer = L.Trainer(
        strategy=SingleDeviceStrategy(DEVICE, PretendAccelerator()), max_steps=5,
        callbacks=[counter], limit_val_batches=0, default_root_dir=tmp_path, logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module, DataLoader(batches, batch_size=None, collate_fn=lambda batch: batch))
    launches, waits = counter.counts[-1]
    print(launches, waits)
    assert waits <= 3
    assert launches <= 80 < counter.counts[0][0]


def test_numbers_of_rounds_are_sampled_once_and_are_a_bucket_each():
    model, batch = training("model=recurrent"), scene()
    captured = make_step(model)
    for count in (1, 1, 2, 1):
        with model.rounds.fix_count(count):
            captured(batch)
    assert dict(captured.graphs.counts) == {"eager": 2, "captured": 1, "replayed": 1}


def test_too_little_room_is_followed_by_another_capture(monkeypatch):
    captured, batch = make_step(training("model=paper")), scene()
    for _ in range(3):
        captured(batch)
    suffice = iter([False])
    monkeypatch.setattr(capacity.Rooms, "suffice", lambda self: next(suffice, True))
    captured(batch)
    assert captured.graphs.counts["captured"] == 2


def test_a_batch_that_does_not_fit_is_called_and_prepared_once(monkeypatch):
    """For instance one with subjects so tall that downsampled copies are used."""
    model, batch = training("model=paper"), scene()
    wanted = float(call_eagerly(model, batch)[0].detach().cpu())
    captured, calls = make_step(model), []
    predictor = captured.predictor
    prepare = predictor.prepare
    monkeypatch.setattr(predictor, "prepare", lambda *given: calls.append(given) or prepare(*given))
    monkeypatch.setattr(predictor, "needs_copies", lambda _: True)
    found = captured(batch)
    assert float(found.total.detach().cpu()) == pytest.approx(wanted, rel=1e-6)
    assert len(calls) == 1
    assert not captured.graphs.counts


def test_sizes_are_kept_while_they_are_enough():
    """Smaller subjects are replayed, a larger one increases the sizes with a margin, and results do not
    change."""
    model = training("model=hull", "skip=fast")
    captured = make_step(model)
    for share in (0.1, 0.1, 0.07, 0.16, 0.17, 0.05):
        batch = dataclasses.replace(ellipsoid_batch(share, 3, 56, 1), subjects=("a",)).to(DEVICE)
        batch = dataclasses.replace(batch, depths=2.0 * batch.masks)
        total, _, gaussians = call_eagerly(model, batch)
        wanted = gradients_of(model, total)
        found = captured(batch)
        assert found.gaussians == gaussians
        torch.testing.assert_close(found.total.detach().cpu(), total.detach().cpu(), rtol=1e-5, atol=0)
        slope = gradients_of(model, found.total)
        for name in wanted:
            assert (slope[name] - wanted[name]).norm() <= 1e-4 * wanted[name].norm() + 1e-9, name
    assert dict(captured.graphs.counts) == {"eager": 2, "captured": 2, "replayed": 2}


def test_what_cannot_be_captured_is_called(monkeypatch):
    """Other devices, renderers and losses, float16 without a loss scale, predictions, and
    ``model.capture=off`` run eagerly."""
    model, batch = training("model=paper"), scene()
    captured = make_step(model)
    assert captured.captures(batch)
    assert not captured.captures(batch.to("cpu"))
    for parts in ((lambda *_: None, LOSSES), (Renderer(), lambda *_: None)):
        assert not with_backend(CapturedStep(Predictor(model), *parts), OperatorBackend).captures(batch)
    with monkeypatch.context() as patch:
        patch.setattr(torch, "is_autocast_enabled", lambda *_: True)
        patch.setattr(torch, "get_autocast_dtype", lambda *_: torch.float16)
        assert not captured.captures(batch)
        assert captured.captures(batch, is_scaled=True)
    model.encoder.aggregator.patch_embed.cache = object()  # tokens on disk
    assert not captured.captures(batch)
    model.encoder.aggregator.patch_embed.cache = None
    model.eval()
    assert not captured.captures(batch)
    assert not make_step(model.train(), capture="off").captures(batch)


def test_hooks_see_every_step():
    """A step of a model with hooks runs eagerly."""
    model, batch, calls = training("model=paper"), scene(), []
    captured = make_step(model)
    model.encoder.register_forward_hook(lambda *_: calls.append(1))
    with pytest.warns(UserWarning, match="eagerly: a hook of encoder"):
        captured(batch)
    for _ in range(3):
        captured(batch)
    assert len(calls) == 4


def test_shape_buckets_are_part_of_a_checkpoint(tmp_path):
    """A resumed run has the sizes of the run that wrote the checkpoint."""
    module = GHGSModule(training("model=hull", "skip=fast"), Renderer(), LOSSES, Optimization(lr=1e-2))
    captured = with_backend(module.captured_step, OperatorBackend)
    for share in (0.16, 0.05):
        batch = ellipsoid_batch(share, 3, 56, 1)
        captured(dataclasses.replace(batch, depths=2.0 * batch.masks).to(DEVICE))
    path = tmp_path / "state.pt"
    torch.save(captured.state_dict(), path)
    other = CapturedStep(Predictor(module.model), Renderer(), LOSSES)
    other.load_state_dict(torch.load(path, weights_only=True))
    assert other.buckets == captured.buckets
    assert len(other.buckets) == 2
    assert other.buckets.keys() == captured.buckets.keys()
