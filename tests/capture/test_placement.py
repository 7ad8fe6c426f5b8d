"""Cameras from whose places alone a prediction cannot be good: a line of the doctor,
or a refusal."""

import json

import numpy as np
import pytest

from ghgs_capture.camera_report import diagnose
from ghgs_capture.folder import CaptureFolder
from ghgs_lit.errors import InputError
from tests.helpers.figures import Figure


def examine(folder, figure, change=lambda pose: pose):
    cameras = {
        name: {**camera, "extrinsics": np.asarray(change(np.array(camera["extrinsics"]))).tolist()}
        for name, camera in figure.cameras.items()
    }
    return diagnose(CaptureFolder(folder, figure.write(folder, cameras=cameras)))


def test_an_ordinary_ring_is_not_warned_of(tmp_path):
    assert len(examine(tmp_path, Figure()).lines) == 2


@pytest.mark.parametrize(
    "stored", [np.float32, lambda pose: json.loads(json.dumps(np.round(pose, 9).tolist()))]
)
def test_float32_cameras_far_from_the_origin_are_warned_of(tmp_path, stored):
    """In float64 there is nothing to warn of."""
    found = examine(tmp_path, Figure(origin=(1e6, 0, 1e6)), stored)
    said = [line for line in found.lines if "float32" in line]
    assert bool(said) == (stored is np.float32)


def test_a_side_that_no_camera_shows_is_said(tmp_path):
    """Three cameras of a ring of six: 240 degrees without one."""
    figure = Figure(6)
    for name in list(figure.cameras)[3:]:
        del figure.cameras[name]
    figure.names = figure.names[:3]
    found = examine(tmp_path, figure)
    assert any(line.startswith("no camera for 240 degrees between cam") for line in found.lines)


def test_cameras_beside_one_another_are_said_to_guess_depth(tmp_path):
    """Four within a centimetre."""
    figure = Figure()
    first = np.array(figure.cameras["cam0"]["extrinsics"])
    for number, name in enumerate(figure.names):
        pose = first.copy()
        pose[0, 3] += 0.0025 * number
        figure.cameras[name] = {**figure.cameras["cam0"], "extrinsics": pose.tolist()}
    figure.masks, figure.images = (np.repeat(each[:1], 4, 0) for each in (figure.masks, figure.images))
    noise = np.random.default_rng(0).integers(0, 12, figure.images.shape)
    figure.images = (figure.images * 0.9 + noise).astype(np.uint8)
    found = examine(tmp_path, figure)
    assert any("depth is a guess" in line for line in found.lines)


def test_copies_of_one_photograph_are_refused(tmp_path):
    figure = Figure()
    figure.images[2], figure.masks[2] = figure.images[0], figure.masks[0]
    found = examine(tmp_path, figure)
    assert not found.consistent
    assert found.suspects == ("cam0", "cam2")
    assert "the same photograph" in found.lines[0]


@pytest.mark.parametrize("axis", range(3))
def test_a_mirrored_axis_is_refused(tmp_path, axis):
    mirror = np.diag([-1.0 if i == axis else 1.0 for i in range(4)])
    for change in (lambda pose: mirror @ pose, lambda pose: pose @ mirror):
        with pytest.raises(InputError, match=r"expected a rotation .*; found a mirrored axis in"):
            examine(tmp_path, Figure(), change)
