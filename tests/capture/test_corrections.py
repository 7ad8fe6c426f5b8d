"""``auto`` corrects masks, cameras and tone curves that a capture contradicts; an exact capture is predicted
unchanged, bit for bit."""

import dataclasses
import json
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
from tests.helpers.verbs import ghgs

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


KEYS = {"size": 112, "refine_cameras": 0, "refine_masks": 0}
NAMES = ["cam0", "cam1", "cam2", "cam3"]


@pytest.fixture(scope="module")
def exact(tmp_path_factory):
    folder = tmp_path_factory.mktemp("taken")
    return Capture.read(folder, Figure().write(folder))


def seen_with(capture, gammas, gains=(1, 1, 1, 1)):
    """Apply powers and gains to the colours of a capture's photographs."""
    photographs = []
    for photograph, gamma, gain in zip(capture.photographs, gammas, gains, strict=False):
        colors = np.clip(gain * (photograph.image / 255) ** gamma, 0, 1)
        photographs.append(dataclasses.replace(photograph, image=np.round(255 * colors).astype(np.uint8)))
    return dataclasses.replace(capture, photographs=tuple(photographs))


@pytest.mark.parametrize("gamma", [0.8, 1.2])
@pytest.mark.parametrize("view", range(4))
def test_the_gamma_of_one_camera_is_named_and_undone(exact, view, gamma):
    """The model's inputs equal those without the gamma, up to estimation and rounding."""
    gammas = [gamma if place == view else 1.0 for place in range(4)]
    result = predict(seen_with(exact, gammas), **KEYS)
    assert result.tones == {NAMES[view]: pytest.approx(gamma, rel=0.03)}
    right = exact.batch((112, 112)).images
    assert (result.batch.images - right).abs().max() < 0.02


ALIKE = [1.0] * 4
#: Number of photographs, powers and gains of each camera.
NO_TONES = {
    "the same exposure": (4, ALIKE, (1, 1, 1, 1)),
    "one dark camera": (4, ALIKE, (0.7, 1, 1, 1)),
    "different exposures": (4, ALIKE, (0.6, 0.9, 1.1, 0.75)),
    "coloured light": (4, [1.0, np.array([1.2, 1.2, 1 / 1.2]), 1.0, 1.0], (1, 1, 1, 1)),
    "two photographs do not tell which one it is": (2, [1.2, 1.0], (1, 1)),
}


@pytest.mark.parametrize("name", NO_TONES)
def test_what_is_no_tone_curve_of_one_camera_stays_as_it_is(exact, name):
    """Bit for bit equal to the prediction without the search."""
    count, gammas, gains = NO_TONES[name]
    given = seen_with(dataclasses.replace(exact, photographs=exact.photographs[:count]), gammas, gains)
    found, plain = predict(given, **KEYS), predict(given, **KEYS, tones={})
    assert found.tones == plain.tones == {}
    assert torch.equal(found.batch.images, plain.batch.images)
    assert torch.equal(found.gaussians.means, plain.gaussians.means)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with two instants, in which cam2 has a gamma of 0.8, and their cameras."""
    monkeypatch.chdir(tmp_path)
    for instant in ("000", "001"):
        figure = Figure()
        figure.images[2] = np.round(255 * (figure.images[2] / 255) ** 0.8)
        cameras = figure.write(tmp_path / "images" / instant)
    return f"cameras={cameras}", "device=cpu"


PREDICTED = (
    "out=splats",
    "size=112",
    "formats=[ply]",
    "turntable.frames=0",
    "refine_masks=0",
    "refine_cameras=0",
)
LINE = "photograph cam2 has a gamma of about 0.80 beside the others: undone (refine_tones=0 leaves it)\n"


@pytest.mark.parametrize(("images", "folders"), [("images/000", ["."]), ("images", ["000", "001"])])
def test_predict_says_what_it_undoes_once_and_reports_it_of_each_instant(here, capsys, images, folders):
    assert ghgs("predict", f"images={images}", *here, *PREDICTED) == 0
    assert capsys.readouterr().out.count(LINE) == 1
    for folder in folders:
        with open(f"splats/{folder}/report.json") as file:
            assert json.load(file)["tones"] == {"cam2": pytest.approx(0.8, rel=0.03)}


def test_predict_leaves_what_it_is_told_to_leave(here, capsys):
    assert ghgs("predict", "images=images/000", *here, *PREDICTED, "refine_tones=0") == 0
    assert "gamma" not in capsys.readouterr().out
    with open("splats/report.json") as file:
        assert "tones" not in json.load(file)
