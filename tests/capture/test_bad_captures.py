"""Captures that cannot be read yield one line with the place, what was expected and what was found."""

import json
import os
import re
from itertools import pairwise
from string import ascii_lowercase

import numpy as np
import pytest
from PIL import Image

from ghgs_capture import Capture
from ghgs_capture.export.reports import require_free
from ghgs_capture.folder import CaptureFolder
from ghgs_lit.errors import InputError
from tests.helpers.captures import truncate
from tests.helpers.figures import Figure


@pytest.fixture
def place(tmp_path):
    """A valid capture in ``images``."""
    Figure().write(tmp_path / "images")
    return tmp_path


def image(place, name, array, **options):
    Image.fromarray(array).save(place / "images" / f"{name}.png", **options)


def camera(place, **changes):
    """Change or (with ...) delete keys of the camera cam1."""
    path = place / "images" / "cameras.json"
    content = json.loads(path.read_text())
    one = content["cameras"]["cam1"] | changes
    content["cameras"]["cam1"] = {key: value for key, value in one.items() if value is not ...}
    path.write_text(json.dumps(content))


def remove(place, *names):
    for name in names:
        (place / "images" / name).unlink()


def write(place, name, text):
    (place / name).write_text(text)
    return {"cameras": place / name}


def only(place, *names):
    for path in (place / "images").glob("*.png"):
        if path.stem.removesuffix("_mask") not in names:
            path.unlink()


def mirrored(place):
    exif = Image.Exif()
    exif[0x0112] = 2
    image(place, "cam1", Figure().images[1], exif=exif)


def other_suffix(place):
    Image.fromarray(Figure().images[0]).save(place / "images" / "cam0.jpg")


def missing_mask(place):
    (place / "masks").mkdir()
    Image.fromarray(Figure().masks[0]).save(place / "masks" / "cam0.png")
    return {"masks": place / "masks"}


def folders(place, *names):
    for name in names:
        (place / "images" / name).mkdir()
        Image.fromarray(Figure().images[0]).save(place / "images" / name / f"{name}.png")
    only(place)


def pipe(place, name):
    (place / "images" / name).unlink()
    os.mkfifo(place / "images" / name)


def loop(place, name):
    (place / "images" / name).unlink()
    (place / "images" / name).symlink_to(name)


FRAME = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
NARROW = json.dumps({"fl_x": 90, "cx": 48, "cy": 64, "w": 0, "h": 128, "frames": [FRAME]})
LAUGHS = "a: &a [x, x]\n" + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in pairwise(ascii_lowercase))
POSE = np.array(Figure().cameras["cam1"]["extrinsics"])
WIDE = np.zeros((128, 128, 3), np.uint8)

# Damage to the folder (a function that may return options), and parts of the message.
BAD = {
    "no folder": (
        lambda p: {"images": p / "none"},
        "none: expected a folder of photographs",
        "no such folder",
    ),
    "a file": (
        lambda p: {"images": p / "images" / "cam0.png"},
        "expected a folder of photographs; found 'a file'",
    ),
    "no photographs": (lambda p: only(p), "images: expected photographs", "found 'none'"),
    "one photograph": (lambda p: only(p, "cam1"), "images: expected 2 photographs or more; found 1"),
    "no camera": (lambda p: image(p, "back", WIDE), "cam0, cam1", "calibration.names", "found back"),
    "two files": (other_suffix, "cam0.png: expected one file for each photograph", "cam0.jpg"),
    "truncated": (lambda p: truncate(p / "images" / "cam1.png"), "cam1.png: expected a readable image"),
    "16 bits": (lambda p: image(p, "cam1", np.zeros((128, 96), np.uint16)), "cam1.png", "8 bits", "I;16"),
    "mirrored": (mirrored, "cam1.png: expected a photograph that is not mirrored", "orientation 2"),
    "another ratio": (lambda p: image(p, "cam1", WIDE), "size of its photograph", "(128, 128)", "(128, 96)"),
    "no masks": (lambda p: remove(p, "cam1_mask.png"), "cam1.png: expected a mask", "segment=rembg"),
    "missing mask": (missing_mask, "masks: expected a mask of ", "cam1.png; found 'none'"),
    "no mask folder": (lambda p: {"masks": p / "nowhere"}, "masks: expected a folder", "nowhere"),
    "mask size": (
        lambda p: image(p, "cam1_mask", WIDE[:64, :, 0]),
        "cam1_mask.png: expected the size",
        "(64, 128)",
    ),
    "inverted mask": (
        lambda p: image(p, "cam1_mask", ~Figure().masks[1]),
        "cam1_mask.png: expected",
        "not of the background",
    ),
    "empty mask": (lambda p: image(p, "cam1_mask", WIDE[:, :96, 0]), "cam1_mask.png: exp", "0 pixels"),
    "no calibration": (
        lambda p: {"cameras": p / "none.json"},
        "none.json: expected a file or folder",
        "no such",
    ),
    "unknown kind": (lambda p: write(p, "cams.csv", ""), "cams.csv: expected JSON", "found '.csv'"),
    "broken JSON": (lambda p: write(p, "c.json", "{"), "c.json: expected JSON; found"),
    "broken YAML": (lambda p: write(p, "c.yml", "a: [1"), "c.yml: expected YAML of OpenCV; found"),
    "broken TOML": (lambda p: write(p, "c.toml", "[a"), "c.toml: expected TOML; found"),
    "no cameras": (
        lambda p: write(p, "c.json", "{}"),
        "c.json: expected cameras with intrinsics",
        "found []",
    ),
    "no frames": (
        lambda p: write(p, "c.json", '{"frames": []}'),
        "c.json: frames: expected a list of frames",
    ),
    "no intrinsics": (lambda p: camera(p, intrinsics=...), "cameras.json: cam1: expected intrinsics"),
    "infinite": (
        lambda p: camera(p, intrinsics=[[1e999, 0, 1], [0, 1, 1], [0, 0, 1]]),
        "cam1",
        "finite numbers",
    ),
    "no rotation": (
        lambda p: camera(p, extrinsics=(1.1 * POSE).tolist()),
        "cam1: rotation: expected",
        "found",
    ),
    **{
        f"mirrored axis {axis}": (
            lambda p, signs=signs: camera(p, extrinsics=(POSE * signs).tolist()),
            "cam1: rotation: expected a rotation",
            "found a mirrored axis in",
        )
        for axis, signs in enumerate(1.0 - 2.0 * np.eye(3, 4)[:, None])
    },
    "three coefficients": (lambda p: camera(p, distortion=[1, 2, 3]), "cam1: expected 0, 4, 5", "found 3"),
    "a flag that is text": (
        lambda p: camera(p, fisheye="no"),
        "cam1: fisheye: expected true or false",
        "'no'",
    ),
    "calibrated size": (lambda p: camera(p, width=500), "cam1: expected a photograph of 128x500", "128x96"),
    "unknown axes": (
        lambda p: {"calibration": {"axes": "maya"}},
        "calibration.axes: expected one of opencv, opengl",
    ),
    "absurd unit": (
        lambda p: {"calibration": {"unit": 1e300}},
        "calibration.unit: expected a number above 0, from 1e-9 to 1e9",
        "1e+300",
    ),
    "no such option": (
        lambda p: {"calibration": {"axis": "y"}},
        "calibration.axis: expected one of",
        "found 'axis'",
    ),
    "no segmenter": (
        lambda p: (remove(p, "cam1_mask.png"), {"segment": "sam"})[1],
        "segment: expected one of rembg",
    ),
    "a pipe": (lambda p: pipe(p, "cam1.png"), "cam1.png: expected an image", "no regular file"),
    "a pipe for a mask": (lambda p: pipe(p, "cam1_mask.png"), "cam1_mask.png", "no regular file"),
    "a pipe for cameras": (
        lambda p: pipe(p, "cameras.json"),
        "cameras.json: expected JSON",
        "no regular file",
    ),
    "links in a loop": (lambda p: loop(p, "cam1.png"), "cam1.png: expected an image", "Too many levels"),
    "deep JSON": (lambda p: write(p, "c.json", "[" * 9999), "c.json: expected JSON", "recursion"),
    "deep TOML": (lambda p: write(p, "c.toml", "a = " + "[" * 9999), "c.toml: expected TOML", "recursion"),
    "tables of one name": (
        lambda p: write(p, "c.toml", "[a]\nname = 'cam1'\n[b]\nname = 'cam1'"),
        "c.toml: b: expected a name that no other table has; found 'cam1'",
    ),
    "a folder for a photograph": (
        lambda p: (remove(p, "cam1.png"), (p / "images" / "cam1.png").mkdir())[0],
        "cam1.png: expected a photograph; found 'a folder'",
    ),
    "a folder beside photographs": (
        lambda p: (p / "images" / "front.png").mkdir(),
        "front.png: expected a photograph; found 'a folder'",
    ),
    "deep YAML": (lambda p: write(p, "c.yml", "a: " + "[" * 9999), "c.yml: expected YAML", "64 levels"),
    "billion laughs": (lambda p: write(p, "c.yml", LAUGHS), "c.yml: expected YAML", "1000000 values"),
    "alias of itself": (lambda p: write(p, "c.yml", "a: &a [*a]"), "c.yml: expected YAML", "an alias"),
    "no width": (
        lambda p: write(p, "transforms.json", NARROW),
        "frames[0]: width: expected a whole number above 0",
        "found 0.0",
    ),
    "a lens that shows nothing": (
        lambda p: camera(p, distortion=[1e6, 0, 0, 0]),
        "cam1: expected a lens distortion that leaves some of the subject",
        "1000000.0",
    ),
    "two instants": (lambda p: folders(p, "a", "b"), "calibration.names", "found a"),
}


@pytest.mark.parametrize("name", BAD)
def test_one_line_says_what_is_wrong(place, name):
    spoil, *parts = BAD[name]
    options = {"images": place / "images", "cameras": place / "images" / "cameras.json"} | (
        spoil(place) or {}
    )
    with pytest.raises(InputError) as caught:
        Capture.read(**options)
    line = " ".join(str(caught.value).split())
    for part in parts:
        assert part in line
    assert re.search(r": .*expected .*; found", line)


def another_kind(folder, name):
    path = folder / "cam1.png"
    path.rename(folder / name) if name.startswith("cam1") else (folder / name).touch()


OTHER_KINDS = ("cam1.HEIC", "cam1.dng", "cam1", "cam1.png.part", "cam1.mp4", "extra.heif", "extra.NEF")


@pytest.mark.parametrize("name", OTHER_KINDS)
def test_a_photograph_of_another_kind_is_named(place, name):
    """With three others, the fourth used to be left out silently."""
    another_kind(place / "images", name)
    said = (
        rf"{re.escape(name)}: expected a file that can be read \(\.jpg, .*; found another kind \(convert it"
    )
    with pytest.raises(InputError, match=said):
        Capture.read(place / "images", place / "images" / "cameras.json")


@pytest.mark.parametrize("name", ["0001.HEIC", "0001", "0009.heic"])
def test_a_photograph_of_another_kind_in_a_cameras_folder_is_named(place, name):
    """All instants of a camera, or one of them."""
    (place / "images" / "cameras.json").rename(place / "cameras.json")
    for camera in Figure().names:
        folder = place / "instants" / camera
        folder.mkdir(parents=True)
        (place / "images" / f"{camera}.png").rename(folder / "0001.png")
    (place / "instants" / "cam1" / "0001.png").rename(place / "instants" / "cam1" / name)
    with pytest.raises(InputError, match=rf"cam1/{name}: expected a file that can be read"):
        Capture.read(place / "instants", place / "cameras.json")


def test_what_may_lie_beside_photographs(place):
    """Raw files, thumbnails and notes next to photographs, and files with other names, are ignored."""
    for name in (
        "cam1.dng",
        "cam1.heic",
        "cam1.json",
        "cam1.png.txt",
        "cam1.mp4",
        "notes",
        "Thumbs.db",
        "cam9.json",
    ):
        (place / "images" / name).touch()
    assert len(Capture.read(place / "images", place / "images" / "cameras.json").photographs) == 4


@pytest.mark.parametrize("suffix", ["jfif", "jpe", "AVIF"])
def test_further_suffixes_of_kinds_that_are_read(place, suffix):
    kind = "AVIF" if suffix == "AVIF" else "JPEG"
    for path in [path for path in (place / "images").glob("cam?.png")]:
        Image.open(path).save(path.with_suffix(f".{suffix}"), format=kind, quality=95)
        path.unlink()
    assert len(Capture.read(place / "images", place / "images" / "cameras.json").photographs) == 4


def test_links_in_a_loop_beside_photographs_are_no_matter(place):
    """A dangling link, and a folder that links to itself, as in backups."""
    (place / "images" / "loop").symlink_to("loop")
    (place / "images" / "again").symlink_to(place / "images")
    folder = CaptureFolder(place / "images", place / "images" / "cameras.json")
    assert len(folder.photographs(folder.instants[0])) == 4
    require_free(place, ["out.ply"], folder.input_files)
    with pytest.raises(InputError, match="the input"):
        require_free(place / "images" / "again", ["cam0.png"], folder.input_files)
