"""Training steps that are played back, on the pretend device with a stand-in for CUDA graphs."""

import dataclasses
from types import SimpleNamespace

import lightning.pytorch as L
import pytest
import torch
from lightning.pytorch.strategies import SingleDeviceStrategy
from torch.utils.data import DataLoader

from benchmarks.device import drawing_nothing
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.method.playback import Playback
from ghgs_lit.rendering import capacity
from ghgs_lit.rendering.api import Renderer
from ghgs_lit.runtime.recording import Recorder
from ghgs_lit.runtime.watching import is_watched
from ghgs_lit.training import GHGSModule, Optimization, captured
from ghgs_lit.training.averaging import Averaging
from ghgs_lit.training.captured import is_recordable, played
from ghgs_lit.training.cost import Costs
from tests.helpers.losses import losses_of
from tests.helpers.models import make_model
from tests.helpers.pretend_device import DEVICE, pretend_device
from tests.helpers.tape import OperatorTape, SilentTape
from tests.test_device import PretendAccelerator

LOSSES = losses_of({"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 0.0, "depth": 0.2})
PAPER = losses_of({"render_l1": 0.8, "render_ssim": 0.2, "chamfer": 1.0})


@pytest.fixture(autouse=True)
def there():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with pretend_device() as log, drawing_nothing():
        yield log
    torch.set_num_threads(threads)


def recording(*overrides):
    """A model in training that records its steps, with two rounds if it has some."""
    model = make_model(*overrides).to(DEVICE).train()
    model.playback = Playback(*(Recorder(tape=OperatorTape()) for _ in range(2)))
    if model.rounds is not None:
        model.rounds._drawn = lambda: 2
    return model


def scene(size=1, color=1.0, holes=0):
    batch = ellipsoid_batch(0.15, 3, 28, size)
    batch.masks[0, 0, 14, 14 : 14 + holes] = False
    names = tuple(f"subject {holes} {number}" for number in range(size))
    batch = dataclasses.replace(batch, images=color * batch.images, subjects=names)
    bodies = [torch.linspace(-0.3, 0.3, 3 * 40).view(40, 3).roll(n, 1) for n in range(size)]
    return dataclasses.replace(batch, depths=2.0 * batch.masks, body_vertices=bodies).to(DEVICE)


def slopes(model, total):
    """Gradients of a loss by the names of weights, on the CPU."""
    model.zero_grad()
    total.backward()
    named = [(name, weight.grad) for name, weight in model.named_parameters()]
    return {name: slope.cpu() for name, slope in named if slope is not None}


def called(model, batch, losses=LOSSES):
    """The loss and its terms, operator by operator."""
    prediction = model(batch)
    rendering = Renderer()(prediction.gaussians, batch.targets.cameras)
    return *losses(prediction, rendering, batch), len(prediction.gaussians)


@pytest.mark.parametrize(
    ("kind", "size", "losses"),
    [("model=paper", 1, LOSSES), ("model=paper", 2, PAPER), ("model=recurrent", 2, LOSSES)],
)
def test_losses_and_gradients_are_those_of_a_step_that_is_called(kind, size, losses):
    """Of other batches of a class, also where a loss is divided among parts of a step."""
    model = recording(kind)
    for holes, color in ((0, 1.0), (1, 0.9), (2, 0.8)):
        batch = scene(size, color, holes)
        total, values, gaussians = called(model, batch, losses)
        wanted = slopes(model, total / 2)
        found = played(model, Renderer(), losses, batch)
        assert found.gaussians == gaussians
        torch.testing.assert_close(found.total.detach().cpu(), total.detach().cpu(), rtol=1e-6, atol=0)
        assert {name: float(value.cpu()) for name, value in found.values.items()} == pytest.approx(
            {name: float(value.detach().cpu()) for name, value in values.items()}, rel=1e-6
        )
        slope = slopes(model, found.total / 2)
        assert slope.keys() == wanted.keys()
        for name in wanted:
            assert (slope[name] - wanted[name]).abs().max() <= 1e-5 * wanted[name].abs().max(), name
    assert dict(model.playback.steps.counts) == {"eager": 1, "recorded": 1, "played": 1}


def test_a_factor_of_the_loss_changes_no_gradient():
    """The same one or another, with the gradients of a step that is called."""
    model, batch = recording("model=paper"), scene()
    wanted = slopes(model, called(model, batch)[0])
    for exponent in (10, 16, 12):
        scale = torch.full((), 2.0**exponent, device=DEVICE)
        found = played(model, Renderer(), LOSSES, batch, scale)
        slope = slopes(model, found.total * scale)
        for name in wanted:
            wrong = (slope[name] / 2.0**exponent - wanted[name]).abs().max()
            assert wrong <= 1e-5 * wanted[name].abs().max(), name
    assert dict(model.playback.steps.counts) == {"eager": 1, "recorded": 1, "played": 1}


def test_gradients_of_float16_do_not_underflow():
    """2^-26 is 0 in float16, and its multiple is not."""
    weight = torch.ones(4, requires_grad=True)
    total = ((weight.half() * 2.0**-14).sum() * 2.0**-12).float()
    assert captured._differentiated(total, [weight], None)[0].abs().max() == 0
    total = ((weight.half() * 2.0**-14).sum() * 2.0**-12).float()
    (slope,) = captured._differentiated(total, [weight], torch.tensor(2.0**10))
    assert torch.equal(slope, torch.full((4,), 2.0**-26))


def test_weights_that_move_are_read_where_they_are():
    """An optimizer moves them in place; the next step that is played back sees it."""
    model, batch = recording("model=paper"), scene()
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-2)
    totals = []
    for _ in range(4):
        found = played(model, Renderer(), LOSSES, batch)
        totals.append(float(found.total.detach().cpu()))
        wanted = float(called(model, batch)[0].detach().cpu())
        assert totals[-1] == pytest.approx(wanted, rel=1e-6)
        slopes(model, found.total)
        optimizer.step()
    assert len(set(totals)) == 4
    model.to(DEVICE)
    assert not model.playback.steps._recordings


def trained(folder, capture):
    """Weights after four steps of two batches each, and how often passes were played back."""
    model = recording("model=hull")
    model.options = model.options.model_copy(update={"capture": capture})
    module = GHGSModule(model, Renderer(), LOSSES, Optimization(lr=1e-2, warmup=0.0))
    batches = [scene(color=1 - number / 20, holes=number).to("cpu") for number in range(4)]
    trainer = L.Trainer(
        strategy=SingleDeviceStrategy(DEVICE, PretendAccelerator()), max_steps=4, accumulate_grad_batches=2,
        limit_val_batches=0, default_root_dir=folder, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module, DataLoader(batches, batch_size=None, collate_fn=lambda batch: batch))
    weights = {name: weight.detach().cpu() for name, weight in model.named_parameters()}
    return weights, model.playback.steps.counts["played"]


def test_a_training_comes_to_the_same_weights(tmp_path):
    """With Lightning's loop, parts of a step that are summed up, and clipping."""
    (wanted, none), (found, played_back) = (trained(tmp_path, capture) for capture in ("off", "auto"))
    assert (none, played_back) == (0, 6)
    for name in wanted:
        torch.testing.assert_close(found[name], wanted[name], rtol=1e-4, atol=1e-5, msg=name)


class Asked(L.Callback):
    """Launches and waits of each step of a training, the optimizer, the average and logging included."""

    def __init__(self, log):
        self.asked, self.found = log, []

    def on_train_batch_start(self, *_):
        self.asked.clear()

    def on_train_batch_end(self, *_):
        self.found.append((self.asked.launches, self.asked.waits.total()))


def test_a_step_of_a_training_asks_for_little(there, tmp_path, monkeypatch):
    """In Lightning's loop: waits for the plan, for the room of renderings, and for the guard."""
    model, asked = recording("model=hull"), Asked(there)
    model.playback = Playback(*(Recorder(tape=SilentTape()) for _ in range(2)))
    module = GHGSModule(model, Renderer(), LOSSES, Optimization(lr=1e-2, matrix_scale=1.0))
    configured = module.configure_optimizers

    def recording_too():
        answer = configured()
        answer["optimizer"].recorder = Recorder(tape=SilentTape())
        return answer

    monkeypatch.setattr(module, "configure_optimizers", recording_too)
    batches = [scene(color=1 - number / 20).to("cpu") for number in range(5)]
    trainer = L.Trainer(
        strategy=SingleDeviceStrategy(DEVICE, PretendAccelerator()), max_steps=5,
        callbacks=[Averaging(0.999), asked], limit_val_batches=0, default_root_dir=tmp_path, logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip
    trainer.fit(module, DataLoader(batches, batch_size=None, collate_fn=lambda batch: batch))
    launches, waits = asked.found[-1]
    print(launches, waits)
    assert waits <= 3
    assert launches <= 80 < asked.found[0][0]


def test_rounds_are_drawn_once_and_are_a_class_each():
    model, batch = recording("model=recurrent"), scene()
    counts = iter([1, 1, 2, 1])
    model.rounds._drawn = lambda: next(counts)
    for _ in range(4):
        played(model, Renderer(), LOSSES, batch)
    assert next(counts, None) is None
    assert dict(model.playback.steps.counts) == {"eager": 2, "recorded": 1, "played": 1}


def test_too_little_room_is_answered_by_another_recording(monkeypatch):
    model, batch = recording("model=paper"), scene()
    for _ in range(3):
        played(model, Renderer(), LOSSES, batch)
    suffice = iter([False])
    monkeypatch.setattr(capacity.Rooms, "suffice", lambda self: next(suffice, True))
    played(model, Renderer(), LOSSES, batch)
    assert model.playback.steps.counts["recorded"] == 2


def test_a_batch_that_does_not_fit_is_called_and_prepared_once(monkeypatch):
    """Such as one with subjects so tall that smaller copies are predicted, too."""
    model, batch = recording("model=paper"), scene()
    wanted = float(called(model, batch)[0].detach().cpu())
    prepared, calls = model.prepared, []
    monkeypatch.setattr(model, "prepared", lambda *given: calls.append(given) or prepared(*given))
    monkeypatch.setattr(model, "needs_copies", lambda _: True)
    found = played(model, Renderer(), LOSSES, batch)
    assert float(found.total.detach().cpu()) == pytest.approx(wanted, rel=1e-6)
    assert len(calls) == 1
    assert not model.playback.steps.counts


def test_sizes_are_kept_while_they_are_enough():
    """Smaller subjects are played back; one that is larger leaves room for others;
    nothing else changes."""
    model = recording("model=hull", "skip=fast")
    for share in (0.1, 0.1, 0.07, 0.16, 0.17, 0.05):
        batch = dataclasses.replace(ellipsoid_batch(share, 3, 56, 1), subjects=("a",)).to(DEVICE)
        batch = dataclasses.replace(batch, depths=2.0 * batch.masks)
        total, _, gaussians = called(model, batch)
        wanted = slopes(model, total)
        found = played(model, Renderer(), LOSSES, batch)
        assert found.gaussians == gaussians
        torch.testing.assert_close(found.total.detach().cpu(), total.detach().cpu(), rtol=1e-5, atol=0)
        slope = slopes(model, found.total)
        for name in wanted:
            assert (slope[name] - wanted[name]).norm() <= 1e-4 * wanted[name].norm() + 1e-9, name
    assert dict(model.playback.steps.counts) == {"eager": 2, "recorded": 2, "played": 2}


def test_what_cannot_be_recorded_is_called(monkeypatch):
    """Other devices, renderers and losses, float16 without a factor of the loss, predictions,
    ``model.capture=off``."""
    model, batch = recording("model=paper"), scene()
    assert is_recordable(model, Renderer(), LOSSES, batch)
    assert not is_recordable(model, Renderer(), LOSSES, batch.to("cpu"))
    assert not is_recordable(model, lambda *_: None, LOSSES, batch)
    assert not is_recordable(model, Renderer(), lambda *_: None, batch)
    with monkeypatch.context() as patch:
        patch.setattr(torch, "is_autocast_enabled", lambda *_: True)
        patch.setattr(torch, "get_autocast_dtype", lambda *_: torch.float16)
        assert not is_recordable(model, Renderer(), LOSSES, batch)
        assert is_recordable(model, Renderer(), LOSSES, batch, is_scaled=True)
    model.encoder.aggregator.patch_embed.cache = object()  # tokens on disk
    assert not is_recordable(model, Renderer(), LOSSES, batch)
    model.encoder.aggregator.patch_embed.cache = None
    assert not is_recordable(model.eval(), Renderer(), LOSSES, batch)
    model.train().options = model.options.model_copy(update={"capture": "off"})
    assert not is_recordable(model, Renderer(), LOSSES, batch)


def test_times_of_a_step_do_not_keep_it_from_being_played_back():
    """The callback that every training has watches stages only where they are called."""
    model = recording("model=paper")
    for capture, is_free in (("auto", True), ("off", False)):
        model.options = model.options.model_copy(update={"capture": capture})
        module = SimpleNamespace(model=model, renderer=Renderer(), losses=LOSSES, device=DEVICE, ready=None)
        costs = Costs()
        costs.on_train_start(None, module)
        assert is_watched() != is_free
        for mark in (costs.on_train_batch_start, costs.on_before_backward, costs.on_after_backward):
            mark(None, module)
        costs.end("optimizer")
        costs.end("step")
        assert ("forward" in costs._watch.seconds()) == is_free
        costs.teardown(None, module, "fit")
