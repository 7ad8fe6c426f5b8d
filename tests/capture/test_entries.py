"""Entries of calibrations: lenses under every name, types, one meaning each,
and a note of the others."""

import re

import numpy as np
import pytest

from ghgs_capture.formats import read_cameras
from ghgs_lit.errors import InputError
from tests.helpers.calibrations import CAMERA, LENS, frame, one_camera, transforms, write

SPELLINGS = [
    *("D", "d", "dist", "Dist", "dists", "kc", "distortion", "distortions", "lens_distortion"),
    *("distCoeff", "distCoeffs", "dist_coeff", "dist-coeffs", "distCoef", "dist_coefs", "dist_params"),
    *("distortion_coefficients", "distortionCoefficients", "distortion_coefficient", "distortion_coeffs"),
    *("distortion_coef", "distortion_params", "distortion_parameters", "lensDistortionCoefficients"),
]


def test_a_lens_counts_under_every_name(tmp_path):
    for spelling in SPELLINGS:
        for value in (LENS, [LENS]):  # a list, or a row of a matrix as NumPy has it
            np.testing.assert_array_equal(one_camera(tmp_path, **{spelling: value}).distortion, LENS)


def test_a_lens_of_single_numbers_counts(tmp_path):
    numbers = dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True))
    np.testing.assert_array_equal(one_camera(tmp_path, **numbers).distortion, [*LENS, 0, 0, 0])
    fisheye = one_camera(tmp_path, k1=0.1, k2=0.2, k3=0.3, k4=0.4, is_fisheye=True)
    np.testing.assert_array_equal(fisheye.distortion, [0.1, 0.2, 0.3, 0.4])
    assert fisheye.fisheye


@pytest.mark.parametrize(
    ("entries", "line"),
    [
        (
            {"radial_distortion": [0.1, 0.2]},
            r"a: expected lens distortion as D .*found \['radial_distortion'\]",
        ),
        ({"omni": {"xi": 1.2}}, r"found \['omni'\]"),
        ({"camera_model": "omnidirectional"}, "a: camera_model: expected a camera model among .*'omnidirec"),
        ({"distortion_model": "mei"}, "a: distortion_model: expected a camera model among .*; found 'mei'"),
        ({"model": "double sphere"}, r"found \['model'\]"),
        ({"type": "fisheye", "D": [0.1, 0, 0, 0]}, r"found \['type'\]"),
        ({"latlong": True}, r"and no other camera model; found \['latlong'\]"),
        ({"equirectangular": 1}, r"found \['equirectangular'\]"),
        ({"k": [-0.35, 0.12]}, r"found \['k'\]"),
        ({"k": LENS}, r"found \['k'\]"),
        (
            {"D": LENS, "dist": [0.1, 0, 0, 0]},
            "a: expected one distortion; found 'different ones: D and dist'",
        ),
        ({"D": LENS, "k1": 0.3}, r"a: expected one distortion, \[-0\.35, .*found \"another: {'k1': 0\.3}"),
        ({"distortion_model": "equidistant", "fisheye": False, "D": [0.1, 0, 0, 0]}, "expected True beside"),
        ({"distortion_model": "equidistant", "camera_model": "opencv"}, "a: expected one model of the lens"),
        ({"distortion_model": "equidistant", "k1": 0.1, "p1": 0.1}, r"k1 k2 k3 k4; found \['p1'\]"),
    ],
)
def test_a_lens_that_is_not_read_is_refused(tmp_path, entries, line):
    with pytest.raises(InputError, match=line):
        one_camera(tmp_path, **entries)


@pytest.mark.parametrize("model", ["equidistant", "fisheye", "KANNALA_BRANDT", "OPENCV_FISHEYE"])
def test_a_fisheye_is_told_by_its_model(tmp_path, model):
    """Kalibr and ROS say it so, beside a pinhole."""
    lens = {"camera_model": "pinhole", "distortion_model": model, "D": [0.1, 0.2, 0.3, 0.4]}
    camera = one_camera(tmp_path, **lens)
    assert camera.fisheye
    np.testing.assert_array_equal(camera.distortion, lens["D"])
    assert not one_camera(tmp_path, distortion_model="plumb_bob", D=LENS).fisheye


@pytest.mark.filterwarnings("ignore:cameras. entries that are not read. k$")
def test_entries_that_say_the_same_twice(tmp_path):
    """A matrix beside coefficients that are 0, one lens in two forms, and sizes that agree."""
    lens = {"D": LENS, "dist": [LENS], "k1": LENS[0], "k3": LENS[4], "k": [0, 0]}
    size = {"width": 640, "height": 480, "image_size": [640.0, 480.0]}
    camera = one_camera(tmp_path, camera_matrix=CAMERA["K"], fisheye=0, is_fisheye=False, **lens, **size)
    np.testing.assert_array_equal(camera.distortion, LENS)
    np.testing.assert_array_equal(camera.intrinsics, CAMERA["K"])
    assert camera.size == (480, 640)


OWN = {"intrinsics": CAMERA["K"], "extrinsics": np.eye(4).tolist()}


def read_entries(tmp_path, kind, entries):
    """A camera of one of three formats with further entries."""
    if kind == "nerfstudio":
        return next(iter(read_cameras(transforms(tmp_path, frame("a.png", **entries))).cameras.values()))
    camera = OWN if kind == "ghgs" else CAMERA
    file = read_cameras(write(tmp_path / "cameras.json", {"a": camera | entries}))
    assert file.format == kind
    return file.cameras["a"]


KINDS = pytest.mark.parametrize("kind", ["ghgs", "opencv", "nerfstudio"])


@KINDS
@pytest.mark.parametrize("key", ["fisheye", "is_fisheye"])
def test_flags_are_true_or_false(tmp_path, kind, key):
    """Text and 2 once counted as true: a lens of another model, without a word."""
    for value in ("no", "0", 2, -1, 0.5, [1], {"on": True}):
        with pytest.raises(
            InputError, match=rf"{key}: expected true or false; found {re.escape(repr(value))}"
        ):
            read_entries(tmp_path, kind, {key: value})


@KINDS
def test_flags_that_are_read(tmp_path, kind):
    for value, found in ((True, 1), (1, 1), (1.0, 1), (False, 0), (0, 0), (None, 0)):
        camera = read_entries(tmp_path, kind, {"fisheye": value, "k1": 0.1, "k2": 0, "k3": None})
        assert camera.fisheye == bool(found)
        np.testing.assert_array_equal(camera.distortion[:2], [0.1, 0])


WRONG_TYPES = [
    ({"w": 0, "h": 480}, "width: expected a whole number above 0; found 0"),
    ({"w": 640.5, "h": 480}, "width: expected a whole number above 0; found 640.5"),
    ({"w": True, "h": 480}, "w: expected a finite number; found True"),
    ({"w": "wide", "h": 480}, "w: expected a finite number; found 'wide'"),
    ({"k1": True}, "k1: expected a finite number; found True"),
    ({"k1": [0.1]}, r"k1: expected a finite number; found \[0\.1\]"),
    ({"D": [0.1, True, 0, 0]}, r"D: expected numbers; found \[0\.1, True"),
    ({"D": "none"}, "D: expected an array"),
    ({"D": {"k1": 0.1}}, "D: expected an array"),
]


@KINDS
def test_values_have_types(tmp_path, kind):
    for entries, line in WRONG_TYPES:
        with pytest.raises(InputError, match=line):
            read_entries(tmp_path, kind, entries)


@KINDS
def test_entries_that_are_not_read_are_named_in_one_note(tmp_path, kind):
    """Of all cameras and of the file; null is nothing."""
    entries = {"colour": 3, "gain": None, "lens": "Nikkor 35 mm"}
    if kind == "nerfstudio":
        path = transforms(tmp_path, frame("a.png", **entries), frame("b.png", **entries), units="cm")
        named = "colour, lens, units"
    else:
        camera = (OWN if kind == "ghgs" else CAMERA) | entries
        content = {"cameras": {"a": camera, "b": camera, "c": {}}, "units": "cm"}
        path, named = write(tmp_path / "cameras.json", content), "c, colour, lens, units"
    with pytest.warns(UserWarning, match="not read") as shown:
        read_cameras(path)
    assert [str(warning.message) for warning in shown] == [f"cameras: entries that are not read: {named}"]


@pytest.mark.parametrize("place", ["file", "beside"])
def test_a_lens_beside_cameras_is_refused(tmp_path, place):
    """Said once for all cameras it was dropped."""
    content = (
        {"cameras": {"a": CAMERA}, "fisheye": True} if place == "file" else {"a": CAMERA, "fisheye": True}
    )
    with pytest.raises(InputError, match=r"expected lens distortion as D .*found \['fisheye'\]"):
        read_cameras(write(tmp_path / "cameras.json", content))


def test_a_fisheye_lens_is_told_by_model_or_flag(tmp_path):
    lens = {"k1": 0.08, "k2": -0.02, "k3": 0.004, "k4": -0.001}
    for said in ({"is_fisheye": True}, {"camera_model": "OPENCV_FISHEYE"}):
        camera = read_cameras(transforms(tmp_path, frame("a.png"), **lens, **said)).cameras["a"]
        assert camera.fisheye
        np.testing.assert_array_equal(camera.distortion, list(lens.values()))
    for said, line in (
        (
            {"is_fisheye": True, "camera_model": "OPENCV"},
            "is_fisheye: expected False beside OPENCV",
        ),
        ({"k4": 0.1}, r"expected distortion k1 k2 p1 p2 k3; found \['k4'\]"),
        ({"is_fisheye": True, "p1": 0.1}, r"expected distortion k1 k2 k3 k4; found \['p1'\]"),
        ({"ftheta_p0": 1.0}, r"found \['ftheta_p0'\]"),
    ):
        with pytest.raises(InputError, match=line):
            read_cameras(transforms(tmp_path, frame("a.png"), **said))


def test_nerfstudios_simple_radial(tmp_path):
    file = read_cameras(transforms(tmp_path, frame("a.png"), camera_model="SIMPLE_RADIAL", k1=0.05))
    np.testing.assert_array_equal(file.cameras["a"].distortion, [0.05, 0, 0, 0, 0])
