"""Cameras and colour gains shared by several instants: estimation, and the file with the results."""

import dataclasses

import numpy as np
import pytest
import torch

from ghgs_capture import rig as rig_module
from ghgs_capture.capture import Capture
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.prediction import predict
from ghgs_capture.rig import Rig, correct_rig, shared_gains
from ghgs_lit.execution import Predictor
from ghgs_lit.rendering import Renderer
from tests.helpers.figures import Figure

NAMES = [f"cam{v}" for v in range(4)]


def captures(tmp_path, count=4):
    path = Figure().write(tmp_path)
    return [Capture(str(n), Capture.read(tmp_path, path).photographs) for n in range(count)]


class Asked:
    """Stub of :class:`CameraRefinement` that records its arguments and moves every camera."""

    batches = ()

    def __init__(self, rounds, model, renderer, shared):
        assert shared
        Asked.rounds = rounds

    def __call__(self, batch):
        Asked.batches = (*Asked.batches, batch)
        poses = batch.cameras.extrinsics.clone()
        poses[..., 0, 3] += 0.01
        return dataclasses.replace(batch, cameras=dataclasses.replace(batch.cameras, extrinsics=poses))


@pytest.fixture
def asked(monkeypatch):
    Asked.batches = ()
    monkeypatch.setattr(rig_module, "CameraRefinement", Asked)
    return Asked


@pytest.fixture(scope="module")
def model():
    return Predictor.from_checkpoint()


@pytest.mark.parametrize(("doubted", "corrected"), [(1, False), (2, True)])
def test_auto_corrects_where_half_of_the_instants_contradict(
    tmp_path, monkeypatch, asked, model, doubted, corrected
):
    """One instant with a wrong mask does not change the cameras of all."""
    monkeypatch.setattr(
        rig_module, "doubt_of_cameras", lambda capture, batch: "they miss" * (int(capture.name) < doubted)
    )
    rig = correct_rig(captures(tmp_path), model, (56, 56), "auto", 0, Renderer())
    assert (rig is not None) == corrected == bool(asked.batches)
    if rig:
        assert rig.why == "in 2 of 4 instants they miss"
        assert asked.rounds == 4
        assert asked.batches[0].masks.shape[:2] == (4, 4)
        assert rig.moved.keys() == set(NAMES)


def test_an_instant_that_lacks_a_camera_takes_no_part(tmp_path, asked, model):
    three, *whole = captures(tmp_path)
    three = Capture("three", three.photographs[:3])
    rig = correct_rig([three, *whole], model, (56, 56), 3, 0, Renderer())
    assert asked.batches[0].subjects == ("1", "2", "3")
    assert asked.rounds == 3
    assert list(rig.extrinsics) == NAMES
    given = whole[0].photographs[0].extrinsics
    moved = rig.apply(three).photographs[0].extrinsics - given
    assert moved[0, 3] == pytest.approx(0.01)


def test_a_camera_that_most_instants_lack_stays_as_it_is(tmp_path, asked, model):
    whole = captures(tmp_path)
    three = [Capture(c.name, c.photographs[:3]) for c in whole[:3]]
    rig = correct_rig([*three, whole[3]], model, (56, 56), 3, 0, Renderer())
    assert list(rig.extrinsics) == NAMES[:3]
    last = rig.apply(whole[3]).photographs[3]
    np.testing.assert_array_equal(last.extrinsics, whole[3].photographs[3].extrinsics)


#: Two cameras 15 % off, one a little blue; the product over the cameras is 1.
GAINS = np.array([[0.85, 0.85, 0.85], [1.15, 1.15, 1.15], [1.0, 1.0, 1.0], [1.0, 1.0, 1.1]])
GAINS = GAINS / np.exp(np.log(GAINS).mean(0))


def seen_with(path, gains, seed=0):
    """Photographs of a figure by cameras with these gains, without overexposure."""
    figure = Figure(seed=seed)
    dim = np.round((60 + 0.45 * figure.images) * np.reshape(gains, (-1, 1, 1, 3)))
    figure.images = dim.astype(np.uint8)
    return figure.write(path)


def test_gains_are_found_once_and_used(tmp_path, asked, model, monkeypatch):
    """One of three instants has other exposures, which are ignored."""
    for instant, gains in enumerate((GAINS, GAINS, GAINS[::-1])):
        cameras = seen_with(tmp_path / "images" / str(instant), gains, seed=instant)
    folder = CaptureFolder(tmp_path / "images", cameras)
    given = [Capture(name, folder.photographs(name)) for name in folder.instants]
    rig = correct_rig(given, model, (112, 112), 1, 0, Renderer())
    assert list(rig.gains) == NAMES
    found = np.array(list(rig.gains.values()))
    np.testing.assert_allclose(found, GAINS, rtol=0.03)
    np.testing.assert_allclose(found.prod(0), 1, rtol=1e-5)

    capture = rig.apply(given[1])
    # what an instant would guess with
    monkeypatch.setattr("ghgs_lit.method.rounds.rounds.equalize", None)
    result = predict(capture, model, (112, 112), refine_cameras=0, refine_masks=0)
    plain = given[1].batch((112, 112))
    np.testing.assert_allclose(result.batch.log_gains[0].exp(), found, rtol=1e-6)
    factors = torch.from_numpy(found).float()[..., None, None]
    torch.testing.assert_close(result.batch.images[0] * factors, plain.images[0])


def test_gains_of_some_cameras_alone_are_not_used(tmp_path):
    """Each instant then estimates them from unchanged photographs, bit for bit."""
    (without,) = captures(tmp_path, 1)
    extrinsics = {photograph.name: photograph.extrinsics for photograph in without.photographs}
    gains = dict(zip(NAMES[:3], GAINS, strict=False))
    some = Rig(extrinsics, {}, {}, gains=gains).apply(without)
    np.testing.assert_array_equal(some.photographs[0].gains, GAINS[0])
    assert some.photographs[3].gains is None
    one, other = (capture.batch((56, 56)) for capture in (some, without))
    assert one.log_gains is None
    assert torch.equal(one.images, other.images)
    photograph = Capture(some.name, some.photographs[:3]).batch((56, 56))
    assert not torch.equal(photograph.images, one.images[:, :3])


@pytest.mark.parametrize(
    ("each", "expected"),
    [
        ([-1.5, 0.5, 0.5, 0.5], [-0.6931, 0.231, 0.231, 0.231]),
        ([0.3, 0.1, 0.1, 0.1], [0.15, -0.05, -0.05, -0.05]),
    ],
)
def test_gains_are_bounded_with_a_mean_of_one(tmp_path, monkeypatch, model, each, expected):
    """Excessive gains are reduced equally for all cameras, so that written files are readable."""
    batch = captures(tmp_path, 1)[0].batch((56, 56))
    logs = torch.tensor(each)[None, :, None].expand(1, 4, 3)
    monkeypatch.setattr(rig_module, "log_gains", lambda gaussians, batch: logs)
    found = shared_gains(batch, model)
    np.testing.assert_allclose(np.log(found), np.repeat(np.array(expected)[:, None], 3, 1), atol=1e-3)
    np.testing.assert_allclose(found.prod(0), 1, rtol=1e-6)
    assert 0.5 <= found.min() < 1 < found.max() <= 2


def test_exposures_that_change_are_left_to_each_instant(tmp_path, monkeypatch, model):
    """A camera that gets brighter by a third over eight instants; noise of 2 % is not a change."""
    batch = rig_module._together([capture.batch((56, 56)) for capture in captures(tmp_path, 8)])
    logs = torch.zeros(8, 4, 3)
    logs[:, 1] = torch.linspace(0, 0.3, 8)[:, None]
    for noise, change in ((0.02, 0.0), (0.0, 1.0)):
        torch.manual_seed(0)
        seen = change * logs + noise * torch.randn(8, 4, 3)
        monkeypatch.setattr(rig_module, "log_gains", lambda gaussians, batch, seen=seen: seen)
        assert (shared_gains(batch, model) is None) == bool(change)
