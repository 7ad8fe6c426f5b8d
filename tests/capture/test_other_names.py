"""Photographs and masks with names of other systems, and masks of other programs."""

import json
import os
import unicodedata

import numpy as np
import pytest
from PIL import Image

from ghgs_capture import Capture
from ghgs_capture.camera_report import diagnose
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.formats import read_cameras
from ghgs_capture.masks import matte_of_file
from ghgs_capture.photographs import Pixels
from ghgs_lit.errors import InputError
from tests.helpers.calibrations import frame, transforms, write
from tests.helpers.figures import Figure


@pytest.fixture
def capture(tmp_path):
    """Photographs in ``images``, masks in ``masks``, and the calibration next to them."""
    figure = Figure()
    path = figure.write(tmp_path / "images")
    path.rename(tmp_path / "cameras.json")
    (tmp_path / "masks").mkdir()
    for name in figure.names:
        (tmp_path / "images" / f"{name}_mask.png").rename(tmp_path / "masks" / f"{name}.png")
    return tmp_path


def read(capture, **options):
    options = {"masks": capture / "masks"} | options
    return Capture.read(capture / "images", capture / "cameras.json", **options)


def require_right(photographs):
    """Check that all four photographs are read with their own masks."""
    for photograph, mask in zip(photographs, Figure().masks, strict=True):
        np.testing.assert_array_equal(photograph.mask, mask)


def test_photographs_and_masks_may_be_links(capture):
    for folder in ("images", "masks"):
        for path in (capture / folder).iterdir():
            stored = capture / "store" / f"{folder}-{path.name}"
            stored.parent.mkdir(exist_ok=True)
            path.rename(stored)
            path.symlink_to(stored)
    require_right(read(capture).photographs)


def rename(capture, folder, change):
    for path in (capture / folder).iterdir():
        os.rename(path, path.with_name(change(path.name)))


def renamed(capture, change):
    """Rename the cameras of the calibration."""
    content = json.loads((capture / "cameras.json").read_text())
    cameras = {change(name): camera for name, camera in content["cameras"].items()}
    write(capture / "cameras.json", {"cameras": cameras})


def same(name):
    return name


def spelled(form):
    return lambda name: unicodedata.normalize(form, name.replace("cam", "K\u00e4the"))


def in_view(name):
    return name.replace("cam", "view")


# Renaming of photographs, masks and cameras, and options.
RENAMED = {
    "masks of Windows": (same, lambda n: n.replace(".png", ".PNG"), same, {}),
    "masks of COLMAP": (same, lambda n: n.replace(".", ".png."), same, {}),
    "CAM0.PNG": (str.upper, str.upper, same, {}),
    "Cam0.Png": (str.title, str.title, same, {}),
    "numbered cameras": (in_view, in_view, lambda n: n[3:], {"names": {f"view{n}": n for n in range(4)}}),
    "letters of macOS": (spelled("NFD"), spelled("NFC"), spelled("NFC"), {}),
}


@pytest.mark.parametrize("name", RENAMED)
def test_names_of_other_systems(capture, name):
    images, masks, cameras, calibration = RENAMED[name]
    renamed(capture, cameras)
    rename(capture, "images", images)
    rename(capture, "masks", masks)
    require_right(read(capture, calibration=calibration).photographs)


NUMBERED = "{camera}_rgb{n:06d}", "{camera}_mask{n:06d}", ["000000", "000001"]
KINDS = "{n:04d}_img", "{n:04d}_img_fmask", ["0000_img", "0001_img"]
ALPHA = "{camera}-{n}", "{camera}_{n}.alpha", ["0", "1"]


@pytest.mark.parametrize(
    ("place", "masks", "names"),
    [
        *(("rgbs/{camera}", "mattes/{camera}", names) for names in (NUMBERED, KINDS, ALPHA)),
        *(("rgbs/{camera}", "rgbs/{camera}", names) for names in (NUMBERED, KINDS)),
        ("rgbs", "mattes", NUMBERED),
        ("rgbs", "mattes", ("{camera}_img", "{camera}_fmask", ["rgbs"])),
    ],
)
def test_names_that_repeat_camera_and_kind(capture, place, masks, names):
    """In folders of cameras or all in one; masks next to photographs or in a separate folder."""
    photograph, mask, instants = names
    for path in sorted((capture / "images").glob("*.png")):
        sources = ((place, photograph, path), (masks, mask, capture / "masks" / path.name))
        for folder, pattern, source in sources:
            for n in range(len(instants)):
                target = capture / f"{folder}/{pattern}.png".format(camera=path.stem, n=n)
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(source.read_bytes())
    mattes = capture / "mattes" if masks.startswith("mattes") else None
    folder = CaptureFolder(capture / "rgbs", capture / "cameras.json", mattes)
    assert folder.instants == instants
    require_right(folder.photographs(instants[-1]))


def test_a_mask_of_another_camera_is_no_mask(capture):
    os.rename(capture / "masks" / "cam0.png", capture / "masks" / "cam00_mask.png")
    with pytest.raises(InputError, match=r"masks: expected a mask of .*cam0\.png; found"):
        read(capture)


@pytest.mark.parametrize("factor", [2, 0.5])
def test_masks_of_another_size_are_scaled(capture, factor):
    right = read(capture)
    for path in (capture / "masks").iterdir():
        image = Image.open(path).convert("L")
        image.resize((round(image.width * factor), round(image.height * factor)), Image.Resampling.BOX).save(
            path
        )
    for one, other in zip(right.photographs, read(capture).photographs, strict=True):
        assert (one.mask & other.mask).sum() > 0.9 * (one.mask | other.mask).sum()


@pytest.mark.parametrize(
    ("files", "line"),
    [
        (("cameras.json",), None),
        (("cameras.json", "transforms.json"), None),
        (
            ("cameras.json", "other.toml"),
            "expected one file of cameras, or transforms.json; found 'cameras.json",
        ),
        ((), "found a folder without any"),
    ],
)
def test_the_folder_of_a_single_file_of_cameras(capture, files, line):
    folder = capture / "calibration"
    folder.mkdir()
    for name in files:
        (folder / name).write_bytes((capture / "cameras.json").read_bytes())
    if "transforms.json" in files:
        transforms(folder, frame("a.png"))
    if line is None:
        assert (list(read_cameras(folder).cameras) == ["a"]) == ("transforms.json" in files)
        return
    with pytest.raises(InputError, match=line):
        read_cameras(folder)


def test_a_capture_with_an_angle_of_view_alone(capture):
    """Masks and cameras of NeRF's file agree as with a size, also in the report."""
    own = json.loads((capture / "cameras.json").read_text())["cameras"]
    flip = np.diag([1.0, -1, -1, 1])
    frames = [
        frame(f"images\\{n}.png", transform_matrix=(np.linalg.inv(c["extrinsics"]) @ flip).tolist())
        for n, c in own.items()
    ]
    right = read(capture).photographs
    focal, width = right[0].intrinsics[0, 0], right[0].image.shape[1]
    content = {"camera_angle_x": 2 * np.arctan(width / 2 / focal), "frames": frames}
    write(capture / "cameras.json", content)
    for one, other in zip(right, read(capture).photographs, strict=True):
        np.testing.assert_allclose(one.intrinsics, other.intrinsics, atol=1e-9)
    folder = CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    assert diagnose(folder).consistent


def test_a_turned_photograph_of_a_calibration_without_size(capture):
    """The calibration is for the photograph as shown, since OpenCV rotates photographs on reading."""
    own = json.loads((capture / "cameras.json").read_text())["cameras"]
    without = {n: {k: c[k] for k in ("intrinsics", "extrinsics")} for n, c in own.items()}
    write(capture / "cameras.json", {"cameras": without})
    for path in (capture / "images").iterdir():
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(np.rot90(np.asarray(Image.open(path)))).save(path, exif=exif)
    require_right(read(capture).photographs)
    assert diagnose(
        CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    ).consistent


def test_cameras_that_differ_by_case_alone(capture):
    """Exact names are used, and no other is guessed."""
    renamed(capture, lambda name: {"cam2": "CAM1"}.get(name, name))
    rename(capture, "images", lambda n: n.replace("cam1", "Cam1").replace("cam2", "CAM1"))
    with pytest.raises(InputError, match=r"expected photographs named after cameras .*; found Cam1$"):
        read(capture)


def test_masks_that_a_windows_program_names(capture):
    """``masks\\cam0.PNG`` next to transforms.json is ``masks/cam0.png``."""
    own = json.loads((capture / "cameras.json").read_text())["cameras"]
    frames = [frame(f".\\images\\{n}.png", mask_path=f"masks\\{n}.PNG") for n in own]
    for entry, camera in zip(frames, own.values(), strict=True):
        entry["transform_matrix"] = np.linalg.inv(camera["extrinsics"]).tolist()
    size = next(iter(own.values()))
    shared = {"fl_x": size["intrinsics"][0][0], "w": size["width"], "h": size["height"], "frames": frames}
    write(capture / "cameras.json", shared)
    found = Capture.read(capture / "images", capture / "cameras.json", calibration={"axes": "opencv"})
    require_right(found.photographs)
    (capture / "masks" / "cam0.png").unlink()
    with pytest.raises(InputError, match=r"masks\\cam0\.PNG: expected an image; found no such file"):
        Capture.read(capture / "images", capture / "cameras.json")


def one_folder_down(capture, name):
    for folder in ("images", "masks"):
        (capture / folder).rename(capture / name)
        (capture / folder).mkdir()
        (capture / name).rename(capture / folder / name)


@pytest.mark.parametrize("name", ["001", unicodedata.normalize("NFD", "K\u00e4the")])
def test_an_instant_beside_hidden_folders(capture, name):
    """Jupyter's hidden folders, and a name of macOS with a decomposed umlaut."""
    one_folder_down(capture, name)
    hidden = capture / "images" / ".ipynb_checkpoints"
    hidden.mkdir()
    Image.new("RGB", (8, 8)).save(hidden / "cam0-checkpoint.png")
    folder = CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    (instant,) = folder.instants
    require_right(folder.photographs(instant))


VALUES = np.zeros((40, 30), np.uint8)
VALUES[10:30, 8:22] = 255
VOID = VALUES.copy()
VOID[12:28, 10:20] = 15  # VOC: the person is 15, the rim around it 255
SOFT = np.where(VOID == 15, 255, np.where(VALUES == 255, 15, 0)).astype(np.uint8)
DEEP = np.resize(np.array([0, 65535, 32768, 257, 40000, 1], np.uint16), (40, 30))
MATTES = {
    "void": (Image.fromarray(VOID), (VOID == 15) * 255),
    "void of a palette": (Image.fromarray(VOID).convert("P"), (VOID == 15) * 255),
    "a soft matte": (Image.fromarray(SOFT), SOFT),
    "16 bits": (Image.fromarray(DEEP), np.resize([0, 255, 128, 1, 156, 0], (40, 30))),
    "constant alpha": (Image.fromarray(VALUES).convert("RGBA"), VALUES),
    "constant alpha of grey": (Image.fromarray(VALUES).convert("LA"), VALUES),
}


@pytest.mark.parametrize("name", MATTES)
def test_mattes_of_files(tmp_path, name):
    image, expected = MATTES[name]
    image.save(tmp_path / "mask.png")
    pixels = Pixels(np.zeros((40, 30, 3), np.uint8), None, 0)
    np.testing.assert_array_equal(matte_of_file(tmp_path / "mask.png", pixels), expected)


@pytest.mark.parametrize("turns", [1, 3])
def test_a_mask_of_the_stored_pixels_is_turned_as_its_photograph(tmp_path, turns):
    """Photographs of phones are rotated on reading; their masks may be stored either way."""
    stored = np.zeros((4, 6), np.uint8)
    stored[0, :2] = 255
    shown = np.rot90(stored, turns)
    pixels = Pixels(np.zeros((*shown.shape, 3), np.uint8), None, turns)
    for mask in (stored, np.ascontiguousarray(shown)):
        Image.fromarray(mask).save(tmp_path / "mask.png")
        np.testing.assert_array_equal(matte_of_file(tmp_path / "mask.png", pixels), shown)
