"""Captured predictions, on the pretend device with a stand-in for CUDA graphs."""

import copy
import dataclasses

import pytest
import torch

import ghgs_capture
from ghgs_lit.diagnostics.benchmark.scene import ellipsoid_batch
from ghgs_lit.errors import InputError
from ghgs_lit.execution import Predictor
from ghgs_lit.execution.graphs import GraphCache
from ghgs_lit.rendering.capacity import Rooms
from ghgs_lit.runtime.watching import Watcher, watch_stages
from tests.helpers.capture_backends import OperatorBackend
from tests.helpers.models import ATTRIBUTES, close, make_model
from tests.helpers.pretend_device import DEVICE

pytestmark = pytest.mark.usefixtures("there", "no_gradient")


def make_predictor(*overrides):
    """A predictor that captures."""
    predictor = Predictor(make_model(*overrides).eval().to(DEVICE))
    predictor.graphs = GraphCache(limit=16, backend=OperatorBackend())
    return predictor


def scene(share=0.15, color=1.0, views=2, holes=0, size=28):
    """Images of an ellipsoid that covers a fraction ``share``, with holes in the middle of a mask."""
    batch = ellipsoid_batch(share, views, size, 1)
    batch.masks[0, 0, 14, 14 : 14 + holes] = False
    return dataclasses.replace(batch, images=color * batch.images).to(DEVICE)


def counts(predictor):
    return dict(predictor.graphs.counts)


def predict_eagerly(predictor, batch):
    """The prediction with ``model.capture=off``."""
    options = predictor.options.replace(capture="off")
    return Predictor(predictor.model, options, predictor.precision)(batch)


def largest_difference(found, wanted):
    """Largest difference between the Gaussians of two predictions."""
    pairs = ((getattr(each.gaussians, name).cpu() for each in (found, wanted)) for name in ATTRIBUTES)
    return max(float((one - other).abs().max()) for one, other in pairs)


@pytest.mark.parametrize(
    ("kind", "size"),
    [
        (("model=paper", "skip=fast"), 28),
        (("model=recurrent",), 28),
        (("model=paper", "model.pad=multiple"), 24),
        (("model=recurrent", "model.pad=multiple"), 22),
    ],
    ids=str,
)
def test_other_scenes_of_a_bucket_are_predicted_as_eagerly(kind, size):
    """With other masks and colours, and as many Gaussians as each scene has pixels."""
    model = make_predictor(*kind)
    for holes, color in ((0, 1.0), (1, 0.9), (2, 0.8), (3, 1.0)):
        batch = scene(holes=holes, color=color, size=size)
        found, wanted = model(batch), predict_eagerly(model, batch)
        assert len(found.gaussians) == int(batch.masks.cpu().sum()) == len(wanted.gaussians)
        close(found.gaussians.to("cpu"), wanted.gaussians.to("cpu"))
        assert torch.equal(found.gaussians.pixel.cpu(), wanted.gaussians.pixel.cpu())
        torch.testing.assert_close(found.depth.cpu(), wanted.depth.cpu(), rtol=1e-5, atol=1e-5)
    assert counts(model) == {"eager": 2, "captured": 2, "replayed": 4}


def test_photographs_with_smaller_copies_are_predicted_as_eagerly():
    """Both are replayed: the stages for the copies, and at full size, which start from their depths and
    tokens."""
    model = make_predictor("model=recurrent", "rounds.height=14")
    for color in (1.0, 0.9, 0.8, 0.7):
        batch = scene(0.3, color)
        assert model.needs_copies(batch)
        found, wanted = model(batch), predict_eagerly(model, batch)
        close(found.gaussians.to("cpu"), wanted.gaussians.to("cpu"))
    # Work before the plan, the stages for copies, and those at full size.
    assert counts(model) == {"eager": 3, "captured": 3, "replayed": 6}


def test_what_changes_a_prediction_is_another_bucket():
    """Sizes, the number of rounds, and the encoder's choice of patches."""
    model = make_predictor("model=recurrent", "encoder.semantic=null")
    for _ in range(2):
        model(scene())
    model.model.rounds.count = 1
    found = model(scene())
    assert len(found.rounds) == 2
    model(scene(views=3))
    model(scene(0.3))
    assert counts(model) == {"captured": 3, "eager": 7}  # one of them work before the plan


def test_what_is_watched_or_has_a_gradient_is_called():
    """Watchers must observe every stage, and a graph has no gradient."""
    model = make_predictor("model=paper")
    for _ in range(2):
        model(scene())
    before = counts(model)
    with watch_stages(model.model, {"head": "gaussian_head"}, Watcher()):
        model(scene())
    with torch.enable_grad():
        assert model(scene()).gaussians.means.requires_grad
    predict_eagerly(model, scene())
    model.model.train()
    model(scene())
    # Work before the plan is replayed even with gradients, and from another bucket in training.
    assert counts(model) == before | {"replayed": 1, "eager": 3}


def test_too_little_room_is_followed_by_another_capture(monkeypatch):
    """The first graph, whose capacity would be too small again, is dropped."""
    model, batch = make_predictor("model=recurrent"), scene()
    for _ in range(3):
        wanted = model(batch)
    suffice = iter([False])
    monkeypatch.setattr(Rooms, "suffice", lambda self: next(suffice, True))
    close(model(batch).gaussians.to("cpu"), wanted.gaussians.to("cpu"))
    assert counts(model) == {"eager": 2, "captured": 3, "replayed": 4}


def replaced_storage(model):
    model.gaussian_head.load_state_dict(
        {name: 1.5 * value for name, value in model.gaussian_head.state_dict().items()}, assign=True
    )


def replaced_data(model):
    for weight in model.gaussian_head.parameters():
        weight.inner = 1.5 * weight.inner  # the equivalent of ``weight.data = ...`` on the pretend device


def replaced_stage(model):
    model.gaussian_head = make_model("model=paper", seed=1).gaussian_head.to(DEVICE)


def replaced_options(model):
    model.gaussian_head.options = model.gaussian_head.options.replace(offset_limit=0.5)


def replaced_attribute(model):
    model.recalibration.block.similarity = "none"


@pytest.mark.parametrize(
    "change", [replaced_storage, replaced_data, replaced_stage, replaced_options, replaced_attribute]
)
def test_a_changed_model_is_not_replayed(change):
    """After any replacement, also within a stage, the result equals that of an eager call."""
    predictor, batch = make_predictor("model=paper"), scene()
    for _ in range(3):
        before = predictor(batch)
    change(predictor.model)
    for _ in range(3):
        found = predictor(batch)
        assert largest_difference(found, predict_eagerly(predictor, batch)) < 1e-6
        assert largest_difference(found, before) > 1e-5
    assert counts(predictor)["captured"] > 2  # including those of the previous model


def test_hooks_and_replaced_methods_are_called_every_time():
    """Of any module, also within a stage; after their removal, predictions are replayed again."""
    predictor, batch, calls = make_predictor("model=paper"), scene(), []
    head = predictor.model.gaussian_head
    activate = head.activate

    def replaced(*given):
        calls.append("method")
        return activate(*given)

    hook = predictor.model.recalibration.register_forward_hook(lambda *_: calls.append("hook"))
    with pytest.warns(UserWarning, match=r"eagerly: a hook of recalibration"):
        predictor(batch)
    for _ in range(3):
        predictor(batch)
    hook.remove()
    head.activate = replaced
    with pytest.warns(UserWarning, match=r"eagerly: gaussian_head\.activate is replaced"):
        predictor(batch)
    for _ in range(3):
        predictor(batch)
    del head.activate
    assert (calls.count("hook"), calls.count("method")) == (4, 4)
    for _ in range(3):
        predictor(batch)
    assert counts(predictor)["replayed"] > 0


def test_a_copy_captures_anew():
    predictor = make_predictor("model=paper")
    for _ in range(2):
        predictor(scene())
    twin = copy.deepcopy(predictor)
    assert not twin.graphs._graphs
    assert len(predictor.graphs._graphs) == 2


def test_what_precedes_the_plan_keeps_names_and_gradients():
    """Batches that differ only in names share a bucket; images that require gradients get them."""
    model = make_predictor("model=paper")
    for name in ("a", "b", "c"):
        batch = dataclasses.replace(scene(), subjects=(name,), views=(("0", "1"),))
        inside, *_ = model.prepare(batch)
        assert (inside.subjects, inside.views) == ((name,), (("0", "1"),))
        assert inside.targets is batch.targets  # whose skew flag the plan has cached
        assert not vars(batch.targets.cameras)["has_skew"]
    assert counts(model) == {"eager": 1, "captured": 1, "replayed": 1}
    with torch.enable_grad():
        photographs = batch.images.clone().requires_grad_()
        inside, *_ = model.prepare(dataclasses.replace(batch, images=photographs))
    assert inside.images.requires_grad
    assert counts(model) == {"eager": 1, "captured": 1, "replayed": 1}


def test_stages_alone_predict_a_capture():
    """A model without a predictor gets one of its own; a size must be given, since there is no checkpoint."""
    with pytest.raises(InputError, match="size: expected a size in pixels beside a model"):
        ghgs_capture.predict(None, make_model("model=paper"))
