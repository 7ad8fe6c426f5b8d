"""``auto`` corrects what a capture contradicts; an exact capture is predicted unchanged, bit for bit."""

import dataclasses
import re

import numpy as np
import pytest
import torch

from ghgs_capture import prediction as predicting
from ghgs_capture.agreement import CORRECTION, doubt_of_cameras, doubt_of_masks
from ghgs_capture.capture import Capture
from ghgs_capture.prediction import predict
from ghgs_lit.execution import Predictor
from ghgs_lit.geometry.masks import signed_distance
from tests.helpers.figures import Figure
from tests.helpers.models import make_model

SIZE = (112, 84)


@pytest.fixture
def taken(tmp_path):
    figure = Figure(height=256, width=192)
    return Capture.read(tmp_path, figure.write(tmp_path))


def with_outlines(capture, pixels):
    """Enlarge the masks by a number of pixels of their photographs."""
    grown = tuple(
        dataclasses.replace(one, matte=(255 * (signed_distance(one.mask) > -pixels)).astype(np.uint8))
        for one in capture.photographs
    )
    return dataclasses.replace(capture, photographs=grown)


def with_first_camera(capture, turn=0.0, zoom=1.0):
    """Turn the first camera by a number of pixels, or change its focal length."""
    one = capture.photographs[0]
    angle = turn / one.intrinsics[0, 0]
    rotation = np.eye(4)
    rotation[:3:2, :3:2] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    lens = one.intrinsics * [[zoom], [zoom], [1]]
    knocked = dataclasses.replace(one, intrinsics=lens, extrinsics=rotation @ one.extrinsics)
    return dataclasses.replace(capture, photographs=(knocked, *capture.photographs[1:]))


@pytest.mark.parametrize("pixels", [-6, -3, -1.5, 1.5, 3, 6])
def test_masks_that_are_too_large_or_too_small_are_doubted(taken, pixels):
    """In pixels of the crops, 0.42 of those of the photographs; positive inwards."""
    doubt = doubt_of_masks(with_outlines(taken, pixels), SIZE)
    found = [float(number) for number in re.findall(r"[+-]\d\.\d", doubt)]
    assert found == pytest.approx([0.42 * pixels] * 4, abs=0.55)
    assert np.sign(found).tolist() == [np.sign(pixels)] * 4


def test_one_mask_that_is_off_is_enough(taken):
    wrong = with_outlines(taken, 5).photographs
    assert doubt_of_masks(dataclasses.replace(taken, photographs=(wrong[0], *taken.photographs[1:])), SIZE)


@pytest.mark.parametrize("changes", [{"turn": 4.0}, {"zoom": 1.04}])
def test_a_camera_that_is_off_is_doubted(taken, changes):
    wrong = with_first_camera(taken, **changes)
    assert "silhouettes miss one another by 0." in doubt_of_cameras(wrong, wrong.batch(SIZE))


def test_one_camera_that_is_off_by_little_is_doubted_and_named(taken):
    """By two pixels of the photographs, 0.9 of the crops; the others agree without it or its opposite."""
    wrong = with_first_camera(taken, turn=2.0)
    doubt = doubt_of_cameras(wrong, wrong.batch(SIZE))
    missed, without = (float(number) for number in re.findall(r"by (0\.\d+)", doubt))
    assert without < 0.1 * missed < 4e-4  # exact cameras of another subject may miss by 0.004
    assert "without cam0 or cam2 by" in doubt


@pytest.mark.parametrize("views", [3, 4, 5])
@pytest.mark.parametrize("height", [80, 256])
def test_exact_captures_are_not_doubted(tmp_path, views, height):
    """Also for photographs smaller than their crops, and in any unit."""
    figure = Figure(views, height, height * 3 // 4, seed=views, scale=1000.0)
    exact = Capture.read(tmp_path, figure.write(tmp_path))
    assert doubt_of_masks(exact, SIZE) == ""
    assert doubt_of_cameras(exact, exact.batch(SIZE)) == ""


def test_masks_without_an_outline_are_not_doubted(taken):
    full = tuple(dataclasses.replace(one, matte=np.full_like(one.matte, 255)) for one in taken.photographs)
    assert doubt_of_masks(dataclasses.replace(taken, photographs=full), SIZE) == ""


def test_an_exact_capture_is_predicted_as_it_is(taken):
    model = Predictor(make_model("model=hull").eval())
    found, plain = predict(taken, model, 56), predict(taken, model, 56, refine_cameras=0, refine_masks=0)
    assert (found.why, found.moved, found.changed) == ({}, (), ())
    assert torch.equal(found.gaussians.means, plain.gaussians.means)
    assert torch.equal(found.batch.cameras.extrinsics, plain.batch.cameras.extrinsics)


def test_what_is_doubted_is_refined(taken, monkeypatch):
    """As with explicit options; 0 disables it, and cameras are judged by the refined masks."""
    model, wrong = Predictor(make_model("model=hull").eval()), with_outlines(taken, 5)
    seen = []
    monkeypatch.setattr(predicting, "doubt_of_cameras", lambda capture, batch: seen.append(batch) or "")
    found = predict(wrong, model, 56)
    asked = predict(wrong, model, 56, refine_cameras=0, refine_masks=CORRECTION)
    assert list(found.why) == ["refine_masks"]
    assert torch.equal(found.batch.images, asked.batch.images)
    assert torch.equal(seen[0].alpha, asked.batch.alpha)
    assert predict(wrong, model, 56, refine_masks=0).changed == ()
    monkeypatch.setattr(predicting, "doubt_of_cameras", lambda capture, batch: "they are off")
    cameras = predict(taken, model, 56)
    assert cameras.why == {"refine_cameras": "they are off"}
    assert len(cameras.moved) == 4
