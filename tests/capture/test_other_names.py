"""Photographs and masks under the names of other systems, and masks as other programs draw them."""

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
    """Photographs in ``images``, masks in ``masks``, the calibration beside them."""
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


def test_photographs_and_masks_may_be_links(capture):
    right = read(capture)
    for folder in ("images", "masks"):
        for path in (capture / folder).iterdir():
            stored = capture / "store" / f"{folder}-{path.name}"
            stored.parent.mkdir(exist_ok=True)
            path.rename(stored)
            path.symlink_to(stored)
    for one, other in zip(right.photographs, read(capture).photographs, strict=True):
        np.testing.assert_array_equal(one.matte, other.matte)


def rename(capture, folder, change):
    for path in (capture / folder).iterdir():
        os.rename(path, path.with_name(change(path.name)))


def renamed(capture, change):
    """Rename the cameras of the calibration."""
    content = json.loads((capture / "cameras.json").read_text())
    cameras = {change(name): camera for name, camera in content["cameras"].items()}
    write(capture / "cameras.json", {"cameras": cameras})


@pytest.mark.parametrize("change", [lambda n: n.replace(".png", ".PNG"), lambda n: n.replace(".", ".png.")])
def test_names_of_masks(capture, change):
    """``cam0.PNG`` of Windows, and COLMAP's ``cam0.png.png``."""
    rename(capture, "masks", change)
    assert len(read(capture).photographs) == 4


@pytest.mark.parametrize(
    ("photograph", "mask", "instants"),
    [
        ("{camera}_rgb{n:06d}", "{camera}_mask{n:06d}", ["000000", "000001"]),
        ("{n:04d}_img", "{n:04d}_img_fmask", ["0000_img", "0001_img"]),
        ("{camera}-{n}", "{camera}_{n}.alpha", ["0", "1"]),
    ],
)
@pytest.mark.parametrize("beside", [False, True])
def test_names_that_repeat_camera_and_kind(capture, photograph, mask, instants, beside):
    if beside and "mask" not in mask:
        return
    for path in sorted((capture / "images").glob("*.png")):
        for folder, name in (("rgbs", photograph), ("rgbs" if beside else "mattes", mask)):
            place = capture / folder / path.stem
            place.mkdir(parents=True, exist_ok=True)
            source = path if name == photograph else capture / "masks" / path.name
            for n in range(2):
                (place / f"{name.format(camera=path.stem, n=n)}.png").write_bytes(source.read_bytes())
    masks = None if beside else capture / "mattes"
    folder = CaptureFolder(capture / "rgbs", capture / "cameras.json", masks)
    assert folder.instants == instants
    for one, other in zip(folder.photographs(instants[1]), read(capture).photographs, strict=True):
        np.testing.assert_array_equal(one.matte, other.matte)


@pytest.mark.parametrize(
    ("photograph", "mask", "instants"),
    [
        ("{camera}_rgb{n:06d}", "{camera}_mask{n:06d}", ["000000", "000001"]),
        ("{camera}_img", "{camera}_fmask", ["rgbs"]),
    ],
)
def test_names_that_begin_with_the_camera(capture, photograph, mask, instants):
    for folder, name, source in (("rgbs", photograph, "images"), ("mattes", mask, "masks")):
        (capture / folder).mkdir()
        for path in (capture / source).glob("*.png"):
            for n in range(len(instants)):
                place = capture / folder / f"{name.format(camera=path.stem, n=n)}.png"
                place.write_bytes(path.read_bytes())
    folder = CaptureFolder(capture / "rgbs", capture / "cameras.json", capture / "mattes")
    assert folder.instants == instants
    for one, other in zip(folder.photographs(instants[-1]), read(capture).photographs, strict=True):
        np.testing.assert_array_equal(one.matte, other.matte)


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
    """Masks and cameras of NeRF's file agree as with a size, also for the report."""
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
    """As shown, as OpenCV turns photographs: the report took it as stored,
    and accused the cameras."""
    own = json.loads((capture / "cameras.json").read_text())["cameras"]
    without = {n: {k: c[k] for k in ("intrinsics", "extrinsics")} for n, c in own.items()}
    write(capture / "cameras.json", {"cameras": without})
    for path in (capture / "images").iterdir():
        exif = Image.Exif()
        exif[0x0112] = 6
        Image.fromarray(np.rot90(np.asarray(Image.open(path)))).save(path, exif=exif)
    for photograph, mask in zip(read(capture).photographs, Figure().masks, strict=True):
        np.testing.assert_array_equal(photograph.mask, mask)
    assert diagnose(
        CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    ).consistent


@pytest.mark.parametrize("change", [str.upper, str.title, lambda n: n.replace("cam", "Cam")])
def test_names_in_another_case(capture, change):
    """``CAM0.PNG`` of Windows is of the camera ``cam0``."""
    for folder in ("images", "masks"):
        rename(capture, folder, change)
    assert [photograph.name for photograph in read(capture).photographs] == Figure().names


def test_cameras_that_differ_by_case_alone(capture):
    """Exact names count, and no other is guessed."""
    renamed(capture, lambda name: {"cam2": "CAM1"}.get(name, name))
    rename(capture, "images", lambda n: n.replace("cam1", "Cam1").replace("cam2", "CAM1"))
    with pytest.raises(InputError, match=r"expected photographs named after cameras .*; found Cam1$"):
        read(capture)


def test_masks_that_a_windows_program_names(capture):
    """``masks\\cam0.PNG`` beside transforms.json is ``masks/cam0.png``."""
    own = json.loads((capture / "cameras.json").read_text())["cameras"]
    frames = [frame(f".\\images\\{n}.png", mask_path=f"masks\\{n}.PNG") for n in own]
    for entry, camera in zip(frames, own.values(), strict=True):
        entry["transform_matrix"] = np.linalg.inv(camera["extrinsics"]).tolist()
    size = next(iter(own.values()))
    shared = {"fl_x": size["intrinsics"][0][0], "w": size["width"], "h": size["height"], "frames": frames}
    write(capture / "cameras.json", shared)
    found = Capture.read(capture / "images", capture / "cameras.json", calibration={"axes": "opencv"})
    for photograph, mask in zip(found.photographs, Figure().masks, strict=True):
        np.testing.assert_array_equal(photograph.mask, mask)
    (capture / "masks" / "cam0.png").unlink()
    with pytest.raises(InputError, match=r"masks\\cam0\.PNG: expected an image; found no such file"):
        Capture.read(capture / "images", capture / "cameras.json")


def test_numbered_cameras_have_photographs_of_other_names(capture):
    renamed(capture, lambda name: name.removeprefix("cam"))
    for folder in ("images", "masks"):
        rename(capture, folder, lambda name: name.replace("cam", "view"))
    names = {f"view{n}": n for n in range(4)}
    assert len(read(capture, calibration={"names": names}).photographs) == 4


def test_letters_of_macos(capture):
    """An umlaut of two characters in names of files, of one in the calibration."""
    renamed(capture, lambda name: name.replace("cam", "K\u00e4the"))
    for folder, form in (("images", "NFD"), ("masks", "NFC")):
        rename(capture, folder, lambda n, form=form: unicodedata.normalize(form, n.replace("cam", "Käthe")))
    assert len(read(capture).photographs) == 4


def test_a_folder_of_macos(capture):
    """An instant, and a camera's folder, whose name has an umlaut of two characters."""
    name = unicodedata.normalize("NFD", "K\u00e4the")
    for folder in ("images", "masks"):
        (capture / folder).rename(capture / name)
        (capture / folder).mkdir()
        (capture / name).rename(capture / folder / name)
    folder = CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    assert [len(folder.photographs(instant)) for instant in folder.instants] == [4]


def test_hidden_folders_are_no_instants(capture):
    for folder in ("images", "masks"):
        (capture / folder).rename(capture / "001")
        (capture / folder).mkdir()
        (capture / "001").rename(capture / folder / "001")
    hidden = capture / "images" / ".ipynb_checkpoints"
    hidden.mkdir()
    Image.new("RGB", (8, 8)).save(hidden / "cam0-checkpoint.png")
    folder = CaptureFolder(capture / "images", capture / "cameras.json", masks=capture / "masks")
    assert folder.instants == ["001"]


def matte(tmp_path, image):
    image.save(tmp_path / "mask.png")
    return matte_of_file(tmp_path / "mask.png", Pixels(np.zeros((40, 30, 3), np.uint8), None, 0))


def test_void_is_not_the_subject(tmp_path):
    """VOC: the person is 15, the rim around it 255;
    a soft matte has values between, and white is more."""
    values = np.zeros((40, 30), np.uint8)
    values[10:30, 8:22] = 255
    values[12:28, 10:20] = 15
    for mode in ("L", "P"):
        image = Image.fromarray(values)
        image = image if mode == "L" else image.convert("P")
        np.testing.assert_array_equal(matte(tmp_path, image), (values == 15) * 255)
    soft = np.where(values == 255, 15, np.where(values == 15, 255, 0)).astype(np.uint8)
    np.testing.assert_array_equal(matte(tmp_path, Image.fromarray(soft)), soft)


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_alpha_that_says_nothing_leaves_the_colour(tmp_path, mode):
    values = np.zeros((40, 30), np.uint8)
    values[10:30, 8:22] = 255
    np.testing.assert_array_equal(matte(tmp_path, Image.fromarray(values).convert(mode)), values)
