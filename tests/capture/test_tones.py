"""A camera with a different tone curve is found and its photographs are corrected; others are unchanged."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from ghgs_capture.capture import Capture
from ghgs_capture.prediction import predict
from tests.helpers.figures import Figure
from tests.helpers.verbs import ghgs

KEYS = {"size": 112, "refine_cameras": 0, "refine_masks": 0}
NAMES = ["cam0", "cam1", "cam2", "cam3"]


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    folder = tmp_path_factory.mktemp("taken")
    return Capture.read(folder, Figure().write(folder))


def seen_with(capture, gammas, gains=(1, 1, 1, 1)):
    """Apply powers and gains to the colours of a capture's photographs."""
    photographs = []
    for photograph, gamma, gain in zip(capture.photographs, gammas, gains, strict=False):
        colors = np.clip(gain * (photograph.image / 255) ** gamma, 0, 1)
        photographs.append(dataclasses.replace(photograph, image=np.round(255 * colors).astype(np.uint8)))
    return dataclasses.replace(capture, photographs=tuple(photographs))


def but(view, gamma):
    return [gamma if place == view else 1.0 for place in range(4)]


@pytest.mark.parametrize("gamma", [0.8, 1.2])
@pytest.mark.parametrize("view", range(4))
def test_the_gamma_of_one_camera_is_named_and_undone(taken, view, gamma):
    """The model's inputs equal those without the gamma, up to estimation and rounding."""
    result = predict(seen_with(taken, but(view, gamma)), **KEYS)
    assert result.tones == {NAMES[view]: pytest.approx(gamma, rel=0.03)}
    right = taken.batch((112, 112)).images
    assert (result.batch.images - right).abs().max() < 0.02


@pytest.mark.parametrize("gains", [(1, 1, 1, 1), (0.7, 1, 1, 1), (0.6, 0.9, 1.1, 0.75)])
def test_equal_tones_stay_as_they_are_whatever_the_exposures(taken, gains):
    """Bit for bit equal to the prediction without the search."""
    given = seen_with(taken, [1.0] * 4, gains)
    found, plain = predict(given, **KEYS), predict(given, **KEYS, tones={})
    assert found.tones == plain.tones == {}
    assert torch.equal(found.batch.images, plain.batch.images)
    assert torch.equal(found.gaussians.means, plain.gaussians.means)


def test_channels_that_go_different_ways_are_no_tone_curve(taken):
    """Coloured light or a wrong white balance relative to the other cameras."""
    tinted = seen_with(taken, [1.0, np.array([1.2, 1.2, 1 / 1.2]), 1.0, 1.0])
    assert predict(tinted, **KEYS).tones == {}


def test_any_unit_and_origin_tell_the_same(tmp_path):
    figure = Figure(scale=1000.0, origin=(3e6, 0, 0))
    far = Capture.read(tmp_path, figure.write(tmp_path))
    assert predict(seen_with(far, but(2, 1.2)), **KEYS).tones == {"cam2": pytest.approx(1.2, rel=0.03)}


def test_two_photographs_do_not_tell_which_one_it_is(taken):
    two = seen_with(dataclasses.replace(taken, photographs=taken.photographs[:2]), [1.2, 1.0])
    assert predict(two, **KEYS).tones == {}


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
