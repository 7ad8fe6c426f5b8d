"""Planted mistakes are reported with the option that corrects them; valid captures are accepted."""

import numpy as np
import pytest

from ghgs_capture.camera_report import diagnose
from ghgs_capture.folder import CaptureFolder
from tests.helpers.figures import Figure, camera_as_stored, write_turned

FLIP = np.diag([1.0, -1, -1, 1])


def pose(change):
    """A mistake in the pose of a camera."""
    return lambda c: {**c, "extrinsics": change(np.array(c["extrinsics"])).tolist()}


def lens(change):
    """A mistake in the intrinsics of a camera."""
    return lambda c: {**c, "intrinsics": change(np.array(c["intrinsics"]), c).tolist()}


def longer(factor):
    return pose(lambda e: np.block([[e[:3, :3], e[:3, 3:] * factor], [e[3:]]]))


def scaled(factor):
    return lens(lambda k, c: k * [[factor], [factor], [1]])


def turned(degrees):
    a = np.radians(degrees)
    turn = np.array([[np.cos(a), 0, np.sin(a), 0], [0, 1, 0, 0], [-np.sin(a), 0, np.cos(a), 0], [0, 0, 0, 1]])
    return pose(lambda e: turn @ e)


NORMALIZED = lens(lambda k, c: k / [[c["width"]], [c["height"]], [1]])
PRINCIPAL = lens(lambda k, c: k / [[1, 1, c["width"]], [1, 1, c["height"]], [1, 1, 1]])
SHIFTED = lens(lambda k, c: k + np.array([[0, 0, 0.1 * c["width"]], [0, 0, 0.05 * c["height"]], [0, 0, 0]]))
INVERSE, OPENGL = pose(np.linalg.inv), pose(lambda e: FLIP @ e)

# Mistakes of all cameras, with the option that corrects them.
ALL = {
    "inverse": (INVERSE, "calibration.extrinsics=camera_to_world"),
    "axes": (OPENGL, "calibration.axes=opengl"),
    "blender": (
        pose(lambda e: np.linalg.inv(e) @ FLIP),
        "calibration.extrinsics=camera_to_world calibration.axes=opengl",
    ),
    "normalized": (NORMALIZED, "calibration.intrinsics=normalized"),
    "normalized principal point": (PRINCIPAL, "calibration.intrinsics=normalized_principal"),
    "photographs halved": (scaled(2), "calibration.resized=0.5"),
    "inverse and photographs doubled": (
        lambda c: INVERSE(scaled(0.5)(c)),
        "calibration.extrinsics=camera_to_world calibration.resized=2",
    ),
}
# Mistakes of one camera of four.
ONE = {
    "inverse": INVERSE,
    "axes": OPENGL,
    "millimetres": longer(1000),
    "principal point": SHIFTED,
    "size": scaled(2),
    "turned by 6 degrees": turned(6),
    "other lens": scaled(1.3),
}


def examine(folder, cameras=None, figure=None, **options):
    figure = figure or Figure()
    return diagnose(CaptureFolder(folder, figure.write(folder, cameras=cameras), **options))


def require_mended(folder, found, **calibration):
    """The reported option makes the cameras fit."""
    assert not found.consistent
    assert diagnose(CaptureFolder(folder, folder / "cameras.json", calibration=calibration)).consistent


@pytest.mark.parametrize("name", ALL)
def test_a_mistake_of_all_cameras_is_mended_by_an_option(tmp_path, name):
    mistake, option = ALL[name]
    found = examine(tmp_path, {camera: mistake(c) for camera, c in Figure().cameras.items()})
    assert found.line.endswith(f" with {option}")
    said = dict(part.removeprefix("calibration.").split("=") for part in option.split())
    require_mended(tmp_path, found, **{k: float(v) if k == "resized" else v for k, v in said.items()})


@pytest.mark.parametrize("name", ONE)
def test_one_camera_that_disagrees_is_named(tmp_path, name):
    cameras = Figure().cameras
    found = examine(tmp_path, {**cameras, "cam2": ONE[name](cameras["cam2"])})
    assert not found.consistent
    assert found.line.startswith("cam2 disagrees with the others")


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_camera_that_hangs_upside_down_or_on_its_side(tmp_path, orientation):
    """Its photograph is rotated by EXIF, its calibration is for the pixels as stored and gives no size."""
    figure = Figure()
    turned = {**figure.cameras, "cam1": camera_as_stored(figure.cameras["cam1"], orientation)}
    for cameras, said, right in ((turned, "auto", "stored"), (figure.cameras, "stored", "shown")):
        matrices = ("intrinsics", "extrinsics")
        unsized = {name: {key: camera[key] for key in matrices} for name, camera in cameras.items()}
        path = figure.write(tmp_path, cameras=unsized)
        write_turned(tmp_path / "cam1.png", figure.images[1], orientation)
        found = diagnose(CaptureFolder(tmp_path, path, calibration={"exif": said}))
        assert found.line.endswith(f" with calibration.exif={right}")
        require_mended(tmp_path, found, exif=right)


@pytest.mark.parametrize(
    "order", [(1, 2, 3, 4, 0), (4, 0, 1, 2, 3), (1, 0, 2, 3, 4)], ids=["next", "previous", "exchanged"]
)
def test_cameras_of_other_photographs(tmp_path, order):
    figure = Figure(views=5, jitter=0.1)
    shifted = [figure.names[place] for place in order]
    cameras = {other: figure.cameras[name] for name, other in zip(figure.names, shifted, strict=True)}
    found = examine(tmp_path, cameras, figure)
    names = {a: b for a, b in zip(figure.names, shifted, strict=True) if a != b}
    said = ", ".join(f"{a}: {b}" for a, b in names.items())
    assert f"with 'calibration.names={{{said}}}'" in found.line
    require_mended(tmp_path, found, names=names)


@pytest.mark.parametrize("kind", ["pose", "photograph"])
def test_copies_are_refused(tmp_path, kind):
    figure = Figure()
    if kind == "pose":
        figure.cameras["cam2"] = figure.cameras["cam0"]
    else:
        figure.images[2], figure.masks[2] = figure.images[0], figure.masks[0]
    found = examine(tmp_path, figure=figure)
    assert not found.consistent
    wanted = {"pose": "cam0 and cam2 have the same pose", "photograph": "cam2 disagrees with the others"}
    assert found.line.startswith(wanted[kind])


@pytest.mark.parametrize("factor", [1000, 0.11])
def test_the_height_is_reported(tmp_path, factor):
    found = examine(tmp_path, figure=Figure(scale=factor))
    assert found.consistent
    assert float(found.line.split()[-3]) == pytest.approx(1.73 * factor, rel=0.06)


@pytest.mark.parametrize("seed", range(12))
def test_right_captures_raise_no_alarm(tmp_path, seed):
    """For any number of cameras, lens and direction, ragged masks, and worlds with any origin and unit."""
    rng = np.random.default_rng(seed)
    focal, scale, origin = rng.uniform(0.9, 1.3), 10.0 ** rng.integers(-1, 4), rng.normal(0, 50, 3)
    width = (96, 128)[seed % 2]
    figure = Figure(3 + seed % 3, 128, width, seed, 0.02, focal=focal, scale=scale, origin=origin)
    figure.masks = figure.masks ^ (np.random.default_rng(seed).random(figure.masks.shape) < 0.002)
    found = examine(tmp_path, figure=figure)
    assert found.consistent, found.line
    assert found.line.endswith("units tall")


#: Parts of a mask: the first and the last of its rows, as shares of its height.
LACKING = {"the head": (0.0, 0.15), "the feet": (0.8, 1.0), "a piece": (0.4, 0.6)}


@pytest.mark.parametrize(("view", "seed"), [(0, 0), (1, 3), (2, 7), (3, 0)])
@pytest.mark.parametrize("part", LACKING)
def test_a_mask_that_lacks_a_part_is_named_and_the_complete_ones_are_not(tmp_path, view, part, seed):
    """The others lie outside of the hull and it does not; leaving each out identifies it."""
    figure = Figure(seed=seed, jitter=0.02)
    rows = np.flatnonzero(figure.masks[view].any(1))
    first, end = (rows[0] + round(share * len(rows)) for share in LACKING[part])
    figure.masks[view][first:end] = False
    found = examine(tmp_path, figure=figure)
    assert f"cam{view} disagrees with the others, which agree by" in found.line
    assert " or " not in found.line.replace("or more", "")


def test_where_two_views_may_be_wrong_both_are_named(tmp_path):
    """A part next to the trunk that only one of two opposite views shows: either one mask lacks it or the
    other has too much."""
    figure = Figure(seed=4, jitter=0.02)
    left, right = np.flatnonzero(figure.masks[2].any(0))[[0, -1]]
    figure.masks[2][:, : left + 3 * (right + 1 - left) // 10] = False
    found = examine(tmp_path, figure=figure)
    assert "cam0 or cam2 disagrees with the others" in found.line
