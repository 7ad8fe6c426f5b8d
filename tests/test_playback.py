"""Predictions that are played back, on the pretend device with a stand-in for CUDA graphs."""

import copy
import dataclasses

import pytest
import torch
from torch import nn

from benchmarks.device import drawing_nothing
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.method.playback import Playback
from ghgs_lit.rendering.capacity import Rooms
from ghgs_lit.runtime.recording import Recorder
from ghgs_lit.runtime.watching import Watcher, watched
from tests.helpers.models import close, make_model
from tests.helpers.pretend_device import DEVICE, pretend_device
from tests.helpers.tape import OperatorTape, SilentTape


@pytest.fixture(autouse=True)
def there():
    """Without a gradient, on the pretend device, on one thread."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with torch.no_grad(), pretend_device() as log, drawing_nothing():
        yield log
    torch.set_num_threads(threads)


def recording(*overrides):
    """A model that records."""
    model = make_model(*overrides).eval().to(DEVICE)
    model.playback = Playback(Recorder(tape=OperatorTape()))
    return model


def scene(share=0.15, color=1.0, views=2, holes=0):
    """Photographs of an ellipsoid that covers a ``share`` of them,
    with holes in the middle of a mask."""
    batch = ellipsoid_batch(share, views, 28, 1)
    batch.masks[0, 0, 14, 14 : 14 + holes] = False
    return dataclasses.replace(batch, images=color * batch.images).to(DEVICE)


def counts(model):
    return dict(model.playback.recorder.counts)


def eager(model, batch):
    """The prediction with ``model.capture=off``."""
    before = model.options
    model.options = before.model_copy(update={"capture": "off"})
    found = model(batch)
    model.options = before
    return found


@pytest.mark.parametrize("kind", [("model=paper", "skip=fast"), ("model=recurrent",)], ids=str)
def test_other_scenes_of_a_class_are_predicted_as_eagerly(kind):
    """Other masks and colours; as many Gaussians as each has pixels."""
    model = recording(*kind)
    for holes, color in ((0, 1.0), (1, 0.9), (2, 0.8), (3, 1.0)):
        batch = scene(holes=holes, color=color)
        found, wanted = model(batch), eager(model, batch)
        assert len(found.gaussians) == int(batch.masks.cpu().sum()) == len(wanted.gaussians)
        close(found.gaussians.to("cpu"), wanted.gaussians.to("cpu"))
        torch.testing.assert_close(found.depth.cpu(), wanted.depth.cpu(), rtol=1e-5, atol=1e-5)
    assert counts(model) == {"eager": 2, "recorded": 2, "played": 4}


def test_photographs_with_smaller_copies_are_predicted_as_eagerly():
    """Both the copies and full size, which starts from their depths and tokens, are played back."""
    model = recording("model=recurrent", "rounds.height=14")
    for color in (1.0, 0.9, 0.8, 0.7):
        batch = scene(0.3, color)
        assert model.needs_copies(batch)
        found, wanted = model(batch), eager(model, batch)
        close(found.gaussians.to("cpu"), wanted.gaussians.to("cpu"))
    # What precedes the plan, the stages for copies, and those at full size.
    assert counts(model) == {"eager": 3, "recorded": 3, "played": 6}


def test_what_changes_a_prediction_is_another_class():
    """Sizes, the number of rounds, what the encoder sees."""
    model = recording("model=recurrent", "encoder.semantic=null")
    for _ in range(2):
        model(scene())
    model.rounds.count = 1
    found = model(scene())
    assert len(found.rounds) == 2
    model(scene(views=3))
    model(scene(0.3))
    assert counts(model) == {"recorded": 2, "eager": 6, "played": 2}  # what precedes the plan


def test_what_changes_a_recorded_step_is_part_of_its_key():
    """Steps of training are recorded outside of the model's own playback, with its settings as key."""
    model = make_model("model=recurrent")
    keys = {model.settings()}
    for name, value in (("precision", "bfloat16"), ("keeps_drafts", not model.keeps_drafts)):
        setattr(model, name, value)
        keys.add(model.settings())
    model.rounds.count += 1
    keys.add(model.settings())
    assert len(keys) == 4


def test_what_is_watched_or_has_a_gradient_is_called():
    """Watchers are told of every stage, and a recording has no gradient."""
    model = recording("model=paper")
    for _ in range(2):
        model(scene())
    before = counts(model)
    with watched(model, {"head": "gaussian_head"}, Watcher()):
        model(scene())
    with torch.enable_grad():
        assert model(scene()).gaussians.means.requires_grad
    eager(model, scene())
    model.train()(scene())
    # What precedes the plan is played back with a gradient, and of another class in training.
    assert counts(model) == before | {"played": 1, "eager": 3}


def test_too_little_room_is_answered_by_another_recording(monkeypatch):
    """The first, which would have as little room again, is forgotten."""
    model, batch = recording("model=recurrent"), scene()
    for _ in range(3):
        wanted = model(batch)
    suffice = iter([False])
    monkeypatch.setattr(Rooms, "suffice", lambda self: next(suffice, True))
    close(model(batch).gaussians.to("cpu"), wanted.gaussians.to("cpu"))
    assert counts(model) == {"eager": 2, "recorded": 3, "played": 4}


def test_weights_that_move_are_recorded_again():
    """A recording reads them where they were; a copy of the model has recordings of its own."""
    model, batch = recording("model=paper"), scene()
    for _ in range(2):
        model(batch)
    twin = copy.deepcopy(model)
    assert not twin.playback.recorder._recordings
    assert len(model.playback.recorder._recordings) == 2
    model.to(DEVICE)
    assert not model.playback.recorder._recordings
    for _ in range(2):
        model(batch)
    around = nn.ModuleDict({"model": model})
    around.load_state_dict(around.state_dict(), assign=True)
    assert not model.playback.recorder._recordings


def test_what_is_played_back_is_not_asked_for(there):
    """The encoder, the plan and what surrounds the stages remain, and as many waits as before."""
    model, batch, asked = recording("model=recurrent"), scene(), []
    model.playback.recorder.tape = SilentTape()
    for _ in range(3):
        there.clear()
        model(batch)
        asked.append((there.launches, there.waits.total()))
    (eager, waits), _, (played, as_many) = asked
    print(eager, played, waits, as_many)
    assert 80 * played < eager
    assert as_many <= waits


def test_what_precedes_the_plan_keeps_names_and_gradients():
    """Batches that differ in names alone are one class;
    photographs that are learned get their gradient."""
    model = recording("model=paper")
    for name in ("a", "b", "c"):
        batch = dataclasses.replace(scene(), subjects=(name,), views=(("0", "1"),))
        _, inside, _ = model.prepared(batch)
        assert (inside.subjects, inside.views) == ((name,), (("0", "1"),))
        assert inside.targets is batch.targets  # whose skew the plan has read
        assert not vars(batch.targets.cameras)["has_skew"]
    assert counts(model) == {"eager": 1, "recorded": 1, "played": 1}
    with torch.enable_grad():
        photographs = batch.images.clone().requires_grad_()
        _, inside, _ = model.prepared(dataclasses.replace(batch, images=photographs))
    assert inside.images.requires_grad
    assert counts(model) == {"eager": 1, "recorded": 1, "played": 1}
