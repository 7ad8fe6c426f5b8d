"""Images of data sets and captures: formats, colour profiles, EXIF, and files with hidden defects."""

import dataclasses
import warnings

import numpy as np
import pytest
from PIL import EpsImagePlugin, ExifTags, Image

from ghgs_capture.photographs import read_pixels
from ghgs_lit.data.decoding import (
    check_extrinsics,
    check_intrinsics,
    limit_formats,
    read_image,
    read_map,
    read_photograph,
)
from ghgs_lit.data.reader import Photographs, Reader
from ghgs_lit.data.view import View
from ghgs_lit.errors import InputError
from ghgs_people.scans import ScanSource
from tests.helpers.captures import refused
from tests.helpers.people import write_obj_scan
from tests.helpers.profiles import DISPLAY_P3, SRGB, in_srgb, profile

READERS = {"data set": read_photograph, "capture": lambda path: read_pixels(path).image}
read = pytest.mark.parametrize("reader", READERS.values(), ids=READERS.keys())


@pytest.fixture
def pixels():
    """[16, 16, 3] uint8, colours that stay inside sRGB for all profiles of the tests."""
    return np.random.default_rng(0).integers(90, 200, (16, 16, 3), np.uint8)


@read
@pytest.mark.parametrize(
    ("suffix", "primaries", "gamma"),
    [
        ("png", DISPLAY_P3, None),
        ("tif", SRGB, 1.0),
        ("webp", DISPLAY_P3, 1.0),
        ("png", SRGB, 1.8),
        ("tif", DISPLAY_P3, None),
        ("webp", SRGB, 1.8),
    ],
    ids=lambda value: str(value) if isinstance(value, str | float) else "",
)
def test_the_colours_of_a_profile_are_those_of_its_formula(
    tmp_path, pixels, reader, primaries, gamma, suffix
):
    path = tmp_path / f"a.{suffix}"
    options = {"lossless": True} if suffix == "webp" else {}
    Image.fromarray(pixels).save(path, icc_profile=profile(primaries, gamma), **options)
    expected = in_srgb(pixels, primaries, gamma)
    assert np.abs(expected - pixels).max() > 10  # the profile has an effect
    # LittleCMS rounds linear light to 15 bits before the curve, and the result to 8 bits.
    assert np.abs(reader(path) - expected).max() <= 1.5


@read
def test_a_profile_of_srgb_changes_no_bit(tmp_path, reader):
    """Most cameras embed an sRGB profile, and data that models were trained on must not change."""
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=profile(SRGB, None))
    assert np.array_equal(reader(tmp_path / "a.png"), pixels)


@read
def test_profiles_of_grey_of_palettes_and_beside_alpha(tmp_path, pixels, reader):
    for mode in ("L", "LA", "RGBA", "P"):
        image = Image.fromarray(pixels).convert(mode)
        stored, is_grey = np.asarray(image.convert("RGB")), mode[0] == "L"
        image.save(tmp_path / "a.png", icc_profile=profile(None if is_grey else DISPLAY_P3, 1.0))
        expected = in_srgb(stored, SRGB if is_grey else DISPLAY_P3, 1.0)
        assert np.abs(reader(tmp_path / "a.png") - expected).max() <= 1.5


def test_alpha_and_masks_have_no_colours(tmp_path, pixels):
    """Profiles apply to colours, not to mattes and masks."""
    alpha = pixels[..., 0]
    options = {"icc_profile": profile(None, 1.0)}
    Image.fromarray(np.dstack((pixels, alpha))).save(tmp_path / "a.png", icc_profile=profile(SRGB, 1.0))
    Image.fromarray(alpha).save(tmp_path / "mask.png", **options)
    assert np.array_equal(read_pixels(tmp_path / "a.png").alpha, alpha)
    assert np.array_equal(read_map(tmp_path / "mask.png", alpha.shape), alpha)


@read
@pytest.mark.parametrize(
    "damaged",
    [b"no profile", profile(SRGB, 1.0)[:200], profile(None, 1.0)],
    ids=["foreign", "cut", "of grey"],
)
def test_a_profile_that_cannot_be_read_is_named_and_left_out(tmp_path, pixels, reader, damaged):
    Image.fromarray(pixels).save(tmp_path / "a.png", icc_profile=damaged)
    with pytest.warns(UserWarning, match=r"a\.png: expected an ICC profile of its pixels; found .*sRGB$"):
        found = reader(tmp_path / "a.png")
    assert np.array_equal(found, pixels)


def with_exif(path, pixels, data):
    Image.fromarray(pixels).save(path, exif=data)
    return path


def orientation(value):
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = value
    return exif.tobytes()


@read
@pytest.mark.parametrize("suffix", ["jpg", "png"])
def test_an_orientation_that_is_none_is_as_stored(tmp_path, pixels, reader, suffix):
    """Several programs write 0 for "unknown", and viewers and OpenCV show such images as stored."""
    for value in (0, 9, 255):
        path = with_exif(tmp_path / f"a.{suffix}", pixels, orientation(value))
        Image.fromarray(pixels).save(tmp_path / f"b.{suffix}")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert np.array_equal(reader(path), reader(tmp_path / f"b.{suffix}"))


@read
@pytest.mark.parametrize("suffix", ["png", "webp"])
def test_damaged_exif_is_named_and_as_stored(tmp_path, pixels, reader, suffix):
    for data in (b"Exif\0\0nonsense", b"Exif\0\0II*\0"):
        options = {"lossless": True} if suffix == "webp" else {}
        Image.fromarray(pixels).save(tmp_path / f"a.{suffix}", exif=data, **options)
        with pytest.warns(
            UserWarning, match=rf"a\.{suffix}: expected EXIF data; found .* shown as it is stored"
        ):
            assert np.array_equal(reader(tmp_path / f"a.{suffix}"), pixels)


@pytest.fixture
def no_ghostscript(monkeypatch):
    """Fail if Pillow starts Ghostscript."""

    def start(*arguments, **options):
        raise AssertionError("Ghostscript was started")

    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", start)


def write_eps(path):
    Image.new("RGB", (4, 4)).save(path, format="EPS")


@pytest.mark.usefixtures("no_ghostscript")
@pytest.mark.parametrize("reader", [*READERS.values(), read_image, lambda path: read_map(path, (4, 4))])
def test_a_program_of_the_system_is_never_started(tmp_path, reader):
    """The format follows from content, not from the name: Pillow would run PostScript in Ghostscript."""
    write_eps(tmp_path / "a.png")
    with pytest.raises(InputError, match=r"a\.png: expected a readable image; found cannot identify"):
        reader(tmp_path / "a.png")


@pytest.mark.usefixtures("no_ghostscript")
def test_textures_are_opened_by_the_same_list(tmp_path):
    """The formats are limited also where trimesh opens the textures of a material."""
    folder = write_obj_scan(tmp_path, "a").parent
    texture = next(path for path in folder.iterdir() if path.suffix in (".jpeg", ".jpg", ".png"))
    write_eps(texture)
    with pytest.raises(InputError, match=r"a: |a\.obj: |readable image"):
        ScanSource(tmp_path).load("a")


def test_the_list_holds_inside_alone(tmp_path):
    write_eps(tmp_path / "a.png")
    with limit_formats(), pytest.raises(OSError, match="cannot identify"):
        Image.open(tmp_path / "a.png")
    assert Image.open(tmp_path / "a.png").format == "EPS"


SOUND = View(
    image=np.full((4, 6, 3), 9, np.uint8),
    mask=np.ones((4, 6), bool),
    inverse_depth=np.full((4, 6), 16384, np.uint16),
    intrinsics=np.array([[5, 0, 3], [0, 5, 2], [0, 0, 1]], np.float32),
    extrinsics=np.eye(4, dtype=np.float32),
)


class OneView(Reader):
    """Custom reader that returns ``view`` and ``body``."""

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
    """16-bit and float images are rejected, as Pillow would silently convert them to white or black."""
    path = tmp_path / "0.tiff"
    Image.fromarray(array).save(path)
    refused(
        rf"0\.tiff: expected a photograph of 8 bits a channel; found mode {mode}",
        lambda: read_photograph(path),
    )


def test_photographs_that_are_to_be_turned_are_refused(tmp_path):
    """Images rotated by EXIF are rejected, as masks and cameras could fit the stored or the shown pixels."""
    exif = Image.Exif()
    for turn in (1, 6):
        exif[ExifTags.Base.Orientation] = turn
        Image.fromarray(SOUND.image).save(tmp_path / f"{turn}.jpg", exif=exif)
    assert read_photograph(tmp_path / "1.jpg").shape == (4, 6, 3)
    refused(r"6\.jpg: expected a photograph that is stored as it is shown .*; found EXIF orientation 6",
            lambda: read_photograph(tmp_path / "6.jpg"))  # fmt: skip


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK"])
def test_photographs_of_eight_bits_are_read(tmp_path, mode):
    """Grey, palette and colour images keep their values."""
    path = tmp_path / "0.tiff"
    Image.fromarray(np.full((4, 6, 3), 255, np.uint8)).convert(mode).save(path)
    image = read_photograph(path)
    assert image.shape == (4, 6, 3)
    assert image.min() == 255


def test_maps_of_floats_are_refused(tmp_path):
    """A mask or depth map of floats could contain NaN, and its unit is unknown."""
    path = tmp_path / "mask.tiff"
    Image.fromarray(np.full((4, 4), np.nan, np.float32)).save(path)
    refused(r"mask\.tiff: expected whole numbers; found float32", lambda: read_map(path, (4, 4)))


def transpose(pose: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[:3, 3] = [0, 0, 2]
    return pose.T


@pytest.mark.parametrize(
    ("check", "matrix", "line"),
    [
        (check_extrinsics, transpose(np.eye(4)), r"last row \[0, 0, 0, 1\]; found \[0.0, 0.0, 2.0, 1.0\]"),
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
    """Transposed poses, matrices scaled as a whole, and improper rotations are rejected."""
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
    """Wrong types, sizes or cameras of a custom reader are rejected on the host."""
    view = dataclasses.replace(SOUND, **changes)
    assert Photographs(OneView(SOUND)).view("a", 0) is SOUND
    refused(rf"^a/0\.png: {line}", lambda: Photographs(OneView(view)).view("a", 0))


def test_bodies_with_nan_are_refused():
    """A single NaN vertex would make the whole Chamfer loss NaN."""
    body = np.zeros((5, 3), np.float32)
    body[2, 1] = np.nan
    refused("a: body: expected finite numbers", lambda: OneView(SOUND, body).read_checked_body("a"))


@pytest.mark.parametrize("number", [10**400, float("inf"), float("nan"), "inf", None, True + 0j])
def test_numbers_that_no_camera_has(number):
    """JSON allows 400 digits and Infinity; for the first NumPy would raise another error."""
    intrinsics = [[5, 0, 3], [0, number, 2], [0, 0, 1]]
    refused("cam: expected (an array 3x3|finite numbers); found", lambda: check_intrinsics("cam", intrinsics))
