"""Cameras that several instants share: what is corrected, and the file that says so."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from ghgs_lit.model import GHGS
from ghgs_lit.prediction.capture import rig as rig_module
from ghgs_lit.prediction.capture.capture import Capture
from ghgs_lit.prediction.capture.folder import CaptureFolder
from ghgs_lit.prediction.capture.formats.json_and_toml import json_text
from ghgs_lit.prediction.capture.rig import Rig, corrected_rig
from ghgs_lit.rendering import Renderer
from tests.helpers.figures import Figure

NAMES = [f"cam{v}" for v in range(4)]


def some_rig(figure):
    """Other cameras than the figure's: turned, shifted and zoomed."""
    extrinsics, turn = {}, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for number, name in enumerate(NAMES):
        pose = np.array(figure.cameras[name]["extrinsics"])
        angle = 0.01 * (number + 1)
        small = np.cos(angle) * np.eye(3) + np.sin(angle) * turn
        small[2, 2] = 1
        pose[:3, :3] = pose[:3, :3] @ small
        pose[:3, 3] += [0.01, -0.02, 0.03 * number]
        extrinsics[name] = pose
    return Rig(extrinsics, {name: 1 + 0.01 * n for n, name in enumerate(NAMES)}, dict.fromkeys(NAMES, 1.0))


def same(one, other):
    for first, second in zip(one.photographs, other.photographs, strict=True):
        np.testing.assert_allclose(first.intrinsics, second.intrinsics, atol=1e-9)
        np.testing.assert_allclose(first.extrinsics, second.extrinsics, atol=1e-9)


@pytest.mark.parametrize("orientation", [1, 6])
def test_the_file_of_a_rig_gives_the_corrected_cameras(tmp_path, orientation):
    """Also of photographs that are turned upright, with a lens that bends."""
    figure = Figure()
    cameras = {
        name: {**camera, "distortion": [0.05, -0.01, 0.0, 0.0]} for name, camera in figure.cameras.items()
    }
    path = figure.write(tmp_path / "images", cameras=cameras)
    turns = {1: 0, 6: 3}[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    for name, image in zip(figure.names, figure.images, strict=True):
        stored = np.ascontiguousarray(np.rot90(image, -turns))
        Image.fromarray(stored).save(tmp_path / "images" / f"{name}.png", exif=exif)
    folder = CaptureFolder(tmp_path / "images", path)
    given = Capture(folder.instants[0], folder.photographs(folder.instants[0]))
    rig = some_rig(figure)
    (tmp_path / "rig.json").write_text(json_text(rig.calibrations(folder, [given])))
    read = Capture.read(tmp_path / "images", tmp_path / "rig.json")
    same(read, rig.applied(given))
    assert np.abs(read.photographs[1].extrinsics - given.photographs[1].extrinsics).max() > 0.01
    for one, other in zip(given.photographs, read.photographs, strict=True):
        # Another focal length bends a little otherwise.
        assert np.abs(one.image.astype(int) - other.image).mean() < 2


def captures(tmp_path, count=4):
    path = Figure().write(tmp_path)
    return [Capture(str(n), Capture.read(tmp_path, path).photographs) for n in range(count)]


class Asked:
    """In place of :class:`CameraRefinement`: notes what it is given, and moves every camera."""

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
    return GHGS.from_checkpoint()


@pytest.mark.parametrize(("doubted", "corrected"), [(1, False), (2, True)])
def test_auto_corrects_where_half_of_the_instants_contradict(
    tmp_path, monkeypatch, asked, model, doubted, corrected
):
    """One instant with a wrong mask does not move the cameras of all."""
    monkeypatch.setattr(
        rig_module, "doubt_of_cameras", lambda capture, batch: "they miss" * (int(capture.name) < doubted)
    )
    rig = corrected_rig(captures(tmp_path), model, (56, 56), "auto", 0, Renderer())
    assert (rig is not None) == corrected == bool(asked.batches)
    if rig:
        assert rig.why == "in 2 of 4 instants they miss"
        assert asked.rounds == 4
        assert asked.batches[0].masks.shape[:2] == (4, 4)
        assert rig.moved.keys() == set(NAMES)


def test_an_instant_that_lacks_a_camera_takes_no_part(tmp_path, asked, model):
    three, *whole = captures(tmp_path)
    three = Capture("three", three.photographs[:3])
    rig = corrected_rig([three, *whole], model, (56, 56), 3, 0, Renderer())
    assert asked.batches[0].subjects == ("1", "2", "3")
    assert asked.rounds == 3
    assert list(rig.extrinsics) == NAMES
    given = whole[0].photographs[0].extrinsics
    moved = rig.applied(three).photographs[0].extrinsics - given
    assert moved[0, 3] == pytest.approx(0.01)


def test_a_camera_that_most_instants_lack_stays_as_it_is(tmp_path, asked, model):
    """It is in the file of the rig, too: the next capture may have it."""
    whole = captures(tmp_path)
    three = [Capture(c.name, c.photographs[:3]) for c in whole[:3]]
    rig = corrected_rig([*three, whole[3]], model, (56, 56), 3, 0, Renderer())
    assert list(rig.extrinsics) == NAMES[:3]
    last = rig.applied(whole[3]).photographs[3]
    np.testing.assert_array_equal(last.extrinsics, whole[3].photographs[3].extrinsics)
    folder = CaptureFolder(tmp_path, tmp_path / "cameras.json")
    found = rig.calibrations(folder, [*three, whole[3]])
    assert list(found) == NAMES
    np.testing.assert_allclose(found["cam3"][0].extrinsics, last.extrinsics, atol=1e-12)
