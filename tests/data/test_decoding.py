"""Files that look sound and are not: each is refused with its path,
before its values reach a batch."""

import dataclasses

import numpy as np
import pytest
from PIL import ExifTags, Image

from ghgs_lit.data.decoding import check_extrinsics, check_intrinsics, read_map, read_photograph
from ghgs_lit.data.reader import Photographs, Reader
from ghgs_lit.data.view import View
from tests.helpers.captures import refused

SOUND = View(
    image=np.full((4, 6, 3), 9, np.uint8),
    mask=np.ones((4, 6), bool),
    inverse_depth=np.full((4, 6), 16384, np.uint16),
    intrinsics=np.array([[5, 0, 3], [0, 5, 2], [0, 0, 1]], np.float32),
    extrinsics=np.eye(4, dtype=np.float32),
)


class OneView(Reader):
    """A reader of one's own that gives ``view`` and ``body``."""

    def __init__(self, view: View, body: np.ndarray | None = None) -> None:
        super().__init__()
        self.subjects, self._view, self._body = {"a": (0,)}, view, body

    def read_view(self, name, position, view, depth):
        return self._view

    def read_body(self, name):
        return self._body

    def place(self, name, position, view):
        return "a/0.png"


@pytest.mark.parametrize(
    ("array", "mode"),
    [(np.full((4, 4), 40000, np.uint16), "I;16"), (np.full((4, 4), np.nan, np.float32), "F")],
)
def test_photographs_of_other_depths_are_refused(tmp_path, array, mode):
    """16-bit PNG and float TIFF, which Pillow converts to white or black without a word."""
    path = tmp_path / "0.tiff"
    Image.fromarray(array).save(path)
    refused(
        rf"0\.tiff: expected a photograph of 8 bits a channel; found mode {mode}",
        lambda: read_photograph(path),
    )


def test_photographs_that_are_to_be_turned_are_refused(tmp_path):
    """A camera's EXIF orientation: masks and cameras fit either the stored or the shown pixels."""
    exif = Image.Exif()
    for turn in (1, 6):
        exif[ExifTags.Base.Orientation] = turn
        Image.fromarray(SOUND.image).save(tmp_path / f"{turn}.jpg", exif=exif)
    assert read_photograph(tmp_path / "1.jpg").shape == (4, 6, 3)
    refused(r"6\.jpg: expected a photograph that is stored as it is shown .*; found EXIF orientation 6",
            lambda: read_photograph(tmp_path / "6.jpg"))  # fmt: skip


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK"])
def test_photographs_of_eight_bits_are_read(tmp_path, mode):
    """Grey, palette and colour photographs keep their values."""
    path = tmp_path / "0.tiff"
    Image.fromarray(np.full((4, 6, 3), 255, np.uint8)).convert(mode).save(path)
    image = read_photograph(path)
    assert image.shape == (4, 6, 3)
    assert image.min() == 255


def test_maps_of_floats_are_refused(tmp_path):
    """A mask or depth map of floats may hold NaN, and its units are not known."""
    path = tmp_path / "mask.tiff"
    Image.fromarray(np.full((4, 4), np.nan, np.float32)).save(path)
    refused(r"mask\.tiff: expected whole numbers; found float32", lambda: read_map(path, (4, 4)))


def transposed(pose: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[:3, 3] = [0, 0, 2]
    return pose.T


@pytest.mark.parametrize(
    ("check", "matrix", "line"),
    [
        (check_extrinsics, transposed(np.eye(4)), r"last row \[0, 0, 0, 1\]; found \[0.0, 0.0, 2.0, 1.0\]"),
        (check_extrinsics, 2 * np.eye(4), r"last row \[0, 0, 0, 1\]; found \[0.0, 0.0, 0.0, 2.0\]"),
        (check_extrinsics, np.diag([1.002, 1.002, 1.002, 1]), "a rotation in the first three columns"),
        (check_extrinsics, np.diag([1, 1, -1, 1]), "a rotation in the first three columns"),
        (
            check_intrinsics,
            np.diag([5, 5, 2]),
            r"last row \[0, 0, 1\]; found \[0, 0, 2\]|found \[0.0, 0.0, 2.0\]",
        ),
        (check_intrinsics, np.diag([5, 5, 0]), r"last row \[0, 0, 1\]; found \[0.0, 0.0, 0.0\]"),
    ],
)
def test_wrong_cameras_are_refused(check, matrix, line):
    """Transposed poses, matrices that are scaled as a whole, and rotations that are none."""
    refused(f"camera: expected (the )?{line}", lambda: check("camera", matrix))


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"image": SOUND.image.astype(np.float32)}, "image: expected uint8 of 4x6x3; found float32"),
        ({"image": SOUND.image[:2]}, "image: expected uint8 of 4x6x3; found uint8 of 2x6x3"),
        ({"mask": SOUND.mask.astype(np.uint8)}, "mask: expected bool of 4x6; found uint8 of 4x6"),
        ({"inverse_depth": np.full((4, 6), np.nan)}, "inverse_depth: expected uint16 of 4x6; found float64"),
        ({"intrinsics": np.diag([5, 5, 2.0])}, "intrinsics: expected the last row"),
        ({"extrinsics": np.full((4, 4), np.nan)}, "extrinsics: expected finite numbers"),
    ],
)  # fmt: skip
def test_what_a_reader_gives_is_checked(changes, line):
    """A reader of one's own that returns other types, sizes or cameras is stopped on the host."""
    view = dataclasses.replace(SOUND, **changes)
    assert Photographs(OneView(SOUND)).view("a", 0) is SOUND
    refused(rf"^a/0\.png: {line}", lambda: Photographs(OneView(view)).view("a", 0))


def test_bodies_with_nan_are_refused():
    """One NaN vertex would make the whole Chamfer loss NaN."""
    body = np.zeros((5, 3), np.float32)
    body[2, 1] = np.nan
    refused("a: body: expected finite numbers", lambda: Photographs(OneView(SOUND, body)).body("a"))


@pytest.mark.parametrize("number", [10**400, float("inf"), float("nan"), "inf", None, True + 0j])
def test_numbers_that_no_camera_has(number):
    """JSON allows 400 digits and Infinity; NumPy converts the first with an error of its own."""
    intrinsics = [[5, 0, 3], [0, number, 2], [0, 0, 1]]
    refused("cam: expected (an array 3x3|finite numbers); found", lambda: check_intrinsics("cam", intrinsics))
