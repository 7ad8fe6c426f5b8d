"""Planted mistakes are named, with the option that mends them; right captures raise no alarm."""

import numpy as np
import pytest
from PIL import Image

from ghgs_capture.camera_report import diagnose
from ghgs_capture.drawing import camera_sheet
from ghgs_capture.folder import CaptureFolder
from ghgs_lit.data.view import area_mask
from ghgs_lit.geometry.silhouettes import HullSearch, Silhouette
from tests.helpers.figures import Figure
from tests.helpers.mistakes import ALL, ONE


def coarse(photograph, cells):
    """The silhouette of a photograph in at most ``cells`` along its longer side."""
    shape = np.array(photograph.mask.shape)
    size = np.maximum(np.round(shape * min(cells / shape.max(), 1)).astype(int), 1)
    intrinsics = photograph.intrinsics.copy()
    intrinsics[:2] *= (size / shape)[::-1, None]
    return Silhouette(area_mask(photograph.mask, *size.tolist()), intrinsics, photograph.extrinsics)


def examine(folder, cameras=None, figure=None):
    figure = figure or Figure()
    return diagnose(CaptureFolder(folder, figure.write(folder, cameras=cameras)))


@pytest.mark.parametrize("name", ALL)
def test_a_mistake_of_all_cameras_is_mended_by_an_option(tmp_path, name):
    mistake, option = ALL[name]
    figure = Figure()
    cameras = {camera: mistake(c) for camera, c in figure.cameras.items()}
    found = examine(tmp_path, cameras, figure)
    assert not found.consistent
    assert found.option == option
    said = dict(part.removeprefix("calibration.").split("=") for part in option.split())
    said = {k: float(v) if k == "resized" else v for k, v in said.items()}
    assert diagnose(CaptureFolder(tmp_path, tmp_path / "cameras.json", calibration=said)).consistent


@pytest.mark.parametrize("name", ONE)
def test_one_camera_that_disagrees_is_named(tmp_path, name):
    mistake, words = ONE[name]
    figure = Figure()
    found = examine(tmp_path, {**figure.cameras, "cam2": mistake(figure.cameras["cam2"])}, figure)
    assert not found.consistent
    assert found.suspects == ("cam2",)
    assert any(words in line and "cam2" in line for line in found.lines)


def test_a_camera_that_hangs_upside_down(tmp_path):
    """Its file is turned by EXIF, its calibration is of the pixels as stored."""
    figure = Figure()
    exif = Image.Exif()
    exif[0x0112] = 3
    stored = np.ascontiguousarray(np.rot90(figure.images[1], 2))
    cameras = {**figure.cameras, "cam1": half_turned(figure.cameras["cam1"])}
    path = figure.write(tmp_path, cameras=cameras)
    Image.fromarray(stored).save(tmp_path / "cam1.png", exif=exif)
    found = diagnose(CaptureFolder(tmp_path, path))
    assert not found.consistent
    assert found.option == "calibration.exif=stored"
    assert diagnose(CaptureFolder(tmp_path, path, calibration={"exif": "stored"})).consistent
    figure.write(tmp_path)
    Image.fromarray(stored).save(tmp_path / "cam1.png", exif=exif)
    assert (
        diagnose(CaptureFolder(tmp_path, path, calibration={"exif": "stored"})).option
        == "calibration.exif=shown"
    )


def half_turned(camera):
    k = np.array(camera["intrinsics"])
    k[:2, 2] = np.array([camera["width"], camera["height"]]) - k[:2, 2]
    pose = np.diag([-1.0, -1, 1, 1]) @ np.array(camera["extrinsics"])
    return {**camera, "intrinsics": k.tolist(), "extrinsics": pose.tolist()}


@pytest.mark.parametrize("step", [1, -1])
def test_cameras_that_are_counted_from_the_next_one(tmp_path, step):
    figure = Figure(views=5, jitter=0.1)
    shifted = figure.names[step:] + figure.names[:step]
    cameras = {other: figure.cameras[name] for name, other in zip(figure.names, shifted, strict=True)}
    found = examine(tmp_path, cameras, figure)
    names = dict(zip(figure.names, shifted, strict=True))
    assert found.option == f"'calibration.names={{{', '.join(f'{a}: {b}' for a, b in names.items())}}}'"
    mended = {"names": names}
    assert diagnose(CaptureFolder(tmp_path, tmp_path / "cameras.json", calibration=mended)).consistent


def test_exchanged_cameras_and_copies_are_named(tmp_path):
    figure = Figure()
    c = figure.cameras
    swapped = examine(tmp_path, {**c, "cam0": c["cam1"], "cam1": c["cam0"]}, figure)
    assert swapped.suspects == ("cam0", "cam1")
    assert swapped.option == "'calibration.names={cam0: cam1, cam1: cam0}'"
    mended = {"names": {"cam0": "cam1", "cam1": "cam0"}}
    assert diagnose(CaptureFolder(tmp_path, tmp_path / "cameras.json", calibration=mended)).consistent
    copied = examine(tmp_path, {**c, "cam3": c["cam1"]}, figure)
    assert copied.suspects == ("cam1", "cam3")
    assert "copy" in copied.lines[0]


def test_exchanged_masks_are_told_from_exchanged_cameras(tmp_path):
    """Both look alike to the hull; the outlines follow edges of the photographs."""
    figure = Figure()
    figure.masks = figure.masks[[0, 2, 1, 3]]
    found = examine(tmp_path, figure=figure)
    assert found.lines[0].startswith("the masks of cam1 and cam2 are exchanged")
    assert found.suspects == ("cam1", "cam2")


@pytest.mark.parametrize(
    ("factor", "words"), [(1000, "millimetres"), (100, "centimetres"), (0.11, "scaled to")]
)
def test_units_are_reported(tmp_path, factor, words):
    figure = Figure(scale=factor)
    found = examine(tmp_path, figure=figure)
    assert found.consistent
    assert words in found.lines[1]
    assert found.size == pytest.approx(1.73 * factor, rel=0.06)


@pytest.mark.parametrize("seed", range(12))
def test_right_captures_raise_no_alarm(tmp_path, seed):
    """Any number of cameras, lens and direction, ragged masks, worlds elsewhere and of any unit."""
    rng = np.random.default_rng(seed)
    options = {
        "focal": rng.uniform(0.9, 1.3),
        "scale": 10.0 ** rng.integers(-1, 4),
        "origin": rng.normal(0, 50, 3),
    }
    figure = Figure(3 + seed % 3, 128, (96, 128)[seed % 2], seed, 0.02, **options)
    figure.masks = figure.masks ^ (np.random.default_rng(seed).random(figure.masks.shape) < 0.002)
    found = examine(tmp_path, figure=figure)
    assert found.consistent, found.lines


def test_agreement_is_the_share_of_a_mask_within_the_hull(tmp_path):
    """Half of a mask that is moved out of the others' sight agrees no more."""
    figure = Figure()
    right = Figure()
    rows = np.flatnonzero(figure.masks[1].any(1))
    middle = int(np.median(rows))
    figure.masks[1][:middle] = False
    figure.write(tmp_path)
    photographs = CaptureFolder(tmp_path, tmp_path / "cameras.json").photographs(tmp_path.name)
    shares = np.array(HullSearch().shares([coarse(photograph, 128) for photograph in photographs]))
    assert shares[1] == 1
    below = right.masks[[0, 2, 3], middle:].sum((1, 2)) / right.masks[[0, 2, 3]].sum((1, 2))
    assert shares[[0, 2, 3]] == pytest.approx(below, abs=0.12)


def test_the_picture_has_the_hull_on_the_mask_and_lines_through_the_body(tmp_path):
    """In a right capture a line runs through the mask of the other photograph."""
    figure = Figure()
    figure.write(tmp_path)
    photographs = CaptureFolder(tmp_path, tmp_path / "cameras.json").photographs(tmp_path.name)
    views = [coarse(photograph, 128) for photograph in photographs]
    picture = camera_sheet(figure.names, [p.image for p in photographs], views)
    assert picture.shape[1] == 4 * 96 + 3 * 2
    assert Image.fromarray(picture).getcolors(1 << 20) is not None
    first_row = picture[14 : 14 + 128, :96]
    hull = (first_row == (255, 60, 40)).all(-1)
    grown = np.pad(figure.masks[0], 4)
    near = np.lib.stride_tricks.sliding_window_view(grown, (9, 9)).any((2, 3))
    assert hull.any()
    assert (hull & near).sum() > 0.3 * hull.sum()
    # of the middle point
    line = (picture[14 + 130 + 14 :][:128, 98 : 98 + 96] == (160, 255, 120)).all(-1)
    assert (line & figure.masks[1]).any()


#: Parts of a mask: the first and the last of its rows, as shares of its height.
LACKING = {"the head": (0.0, 0.15), "the feet": (0.8, 1.0), "a piece": (0.4, 0.6)}


def without_part(figure, view, part):
    """The figure, whose mask of one view lacks a part."""
    rows = np.flatnonzero(figure.masks[view].any(1))
    first, end = (rows[0] + round(share * len(rows)) for share in LACKING[part])
    figure.masks[view][first:end] = False
    return figure


@pytest.mark.parametrize(("view", "seed"), [(0, 0), (1, 3), (2, 7), (3, 0)])
@pytest.mark.parametrize("part", LACKING)
def test_a_mask_that_lacks_a_part_is_named_and_the_complete_ones_are_not(tmp_path, view, part, seed):
    """The others lie outside the hull, and it does not: leaving each out tells."""
    figure = without_part(Figure(seed=seed, jitter=0.02), view, part)
    found = examine(tmp_path, figure=figure)
    assert found.suspects == (f"cam{view}",)
    assert found.lines[-1].startswith(f"cam{view} disagrees with the others, which agree by")
    assert "its mask lacks a part" in found.lines[-1]
    assert found.consistent == (found.ranking[0].score >= 0.9)


def test_where_two_views_may_be_wrong_both_are_named(tmp_path):
    """A part that its opposite alone shows beside the trunk: one mask lacks it or the other has too
    much. The photograph has no edge where the mask ends, and one where the other does."""
    figure = Figure(seed=4, jitter=0.02)
    left, right = np.flatnonzero(figure.masks[2].any(0))[[0, -1]]
    figure.masks[2][:, : left + 3 * (right + 1 - left) // 10] = False
    found = examine(tmp_path, figure=figure)
    assert found.suspects == ("cam2", "cam0")
    assert found.lines[-1].startswith("cam0 or cam2 disagrees with the others")
    assert "rather cam2" in found.lines[-1]
