"""Broken ZJU-MoCap data: each case gets one line that says where,
what was expected and what was found.

The lines are listed in ``docs/evidence/broken_files.md``.
"""

import shutil
from pathlib import Path

import numpy as np
import pytest

from ghgs_lit.data.pickles import load_npy
from scripts.miniatures import zju_mocap
from tests.helpers.captures import (
    Malice,
    blank,
    build_data,
    inside,
    make_miniature,
    refused,
    shrink,
    stored,
    truncate,
)

NAME = "CoreView_386"
PHOTOGRAPH, MASK = "Camera_B1/000000.jpg", "mask_cihp/Camera_B1/000000.png"


def annotated(change):
    """A case that changes what is in ``annots.npy``."""

    def apply(folder: Path) -> None:
        content = load_npy(folder / "annots.npy")
        change(content)
        np.save(folder / "annots.npy", content)

    return apply


def put(kind: str, value):
    """A case that gives the fourth camera another K, R, T or D."""
    return annotated(lambda content: content["cams"][kind].__setitem__(3, value))


def swap(content: dict) -> None:
    cams = content["cams"]
    cams["R"], cams["T"] = cams["T"], cams["R"]


def metres(content: dict) -> None:
    content["cams"]["T"] = [t / 1000 for t in content["cams"]["T"]]


def name(value: str):
    return annotated(lambda content: content["ims"][0]["ims"].__setitem__(2, value))


def body(value):
    return lambda folder: np.save(folder / "new_vertices" / "0.npy", value)


CASES = {
    "no annotations": (
        lambda f: (f / "annots.npy").unlink(),
        r"annots.npy: expected an .npy file; found no such file",
    ),
    "truncated annotations": (
        lambda f: truncate(f / "annots.npy"),
        r"annots.npy: expected a readable pickle; found",
    ),
    "malicious annotations": (
        lambda f: np.save(f / "annots.npy", {"cams": Malice()}),
        r"annots.npy: expected a pickle of NumPy arrays and plain containers; found posix.system",
    ),
    "no cameras": (
        annotated(lambda c: c.pop("cams")),
        r"annots.npy: expected an entry 'cams'; found \['ims'\]",
    ),
    "R and T swapped": (annotated(swap), r"annots.npy: camera 0: R: expected an array 3x3; found 3x1"),
    "fewer lenses": (annotated(lambda c: c["cams"]["D"].pop()), r"expected as many K, D, R and T .* 'D': 22"),
    "NaN camera": (
        put("R", np.full((3, 3), np.nan)),
        r"camera 3: R: expected finite numbers; found NaN or infinity",
    ),
    "no rotation": (
        put("R", 2 * np.eye(3)),
        r"camera 3: expected a rotation in the first three columns; found",
    ),
    "mirrored camera": (
        put("R", np.diag([1.0, 1, -1])),
        r"camera 3: expected a rotation in the first three columns",
    ),
    "focal length 0": (
        put("K", np.diag([0.0, 1, 1])),
        r"camera 3: K: expected focal lengths above 0; found 0.0, 1.0",
    ),
    "lens of 3 numbers": (put("D", np.zeros((3, 1))), r"camera 3: D: expected an array 4 or 5; found 3"),
    "metres": (
        annotated(metres),
        r"expected translations T in millimetres; found cameras within \d+ mm .*metres",
    ),
    "a camera less in a frame": (
        annotated(lambda c: c["ims"][0]["ims"].pop()),
        r"frame 0: expected a photograph for each of 23 cameras; found 22",
    ),
    "wrong frame number": (
        name("Camera_B3/000001.jpg"),
        r"frame 0: expected one frame number for all cameras; found \['000000', '000001'\]",
    ),
    "name without a number": (
        annotated(
            lambda c: c["ims"].__setitem__(0, {"ims": [f"Camera_B{k}/first.jpg" for k in range(1, 24)]})
        ),
        r"Camera_B1/first.jpg: expected a frame number, .*; found 'first.jpg'",
    ),
    "path that leaves": (
        name("../../secret/000000.jpg"),
        r"frame 0: expected paths below the sequence; found '../../secret/000000.jpg'",
    ),
    "no photograph": (
        lambda f: (f / PHOTOGRAPH).unlink(),
        r"CoreView_386/Camera_B1/000000.jpg: expected an image; found no such file",
    ),
    "truncated photograph": (
        lambda f: truncate(f / PHOTOGRAPH),
        r"000000.jpg: expected a readable image; found",
    ),
    "resized photograph": (
        lambda f: (
            shrink(f / PHOTOGRAPH),
            shrink(f / MASK),
            shrink(f / "mask" / PHOTOGRAPH.replace("jpg", "png")),
        ),
        r"000000.jpg: expected a photograph of the calibration's size, .*; found 32x32",
    ),
    "no mask": (
        lambda f: (f / MASK).unlink(),
        r"mask_cihp/Camera_B1/000000.png: expected an image; found no such",
    ),
    "no folder of masks": (
        lambda f: [shutil.rmtree(f / kind) for kind in ("mask", "mask_cihp")],
        r"CoreView_386: expected a folder of masks, mask_cihp; found none",
    ),
    "mask of another size": (
        lambda f: shrink(f / MASK),
        r"000000.png: expected the size of its photograph, 64x64; found 32x32",
    ),
    "empty mask": (
        lambda f: blank(f / MASK),
        r"mask_cihp/Camera_B1/000000.png: expected a subject in the mask; found",
    ),
    "truncated mask": (lambda f: truncate(f / MASK), r"000000.png: expected a readable image; found"),
    "no body of a frame": (
        lambda f: (f / "new_vertices" / "0.npy").unlink(),
        r"new_vertices/0.npy: expected an array 6890x3; found no such file",
    ),
    "body of another model": (body(np.zeros((10475, 3))), r"0.npy: expected an array 6890x3; found 10475x3"),
    "malicious body": (
        body(np.array(Malice(), object)),
        r"0.npy: expected an array 6890x3; found a file that cannot",
    ),
    "NaN body": (body(np.full((6890, 3), np.nan)), r"0.npy: expected finite numbers; found NaN or infinity"),
    "no sequence": (shutil.rmtree, r"expected sequences such as CoreView_386; found none of train"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    make_miniature(zju_mocap, folder, ["386"], 64, seed=3, frames=1)
    return folder / NAME


def read_all(root: Path) -> list:
    """What training and evaluation read of the frame."""
    photographs = stored(build_data("zju_mocap", root, "data.size=64"), "train", (64, 64))
    return [(name, photographs.view(name, 0), photographs.body(name)) for name in photographs.reader.subjects]


def test_the_whole_one_is_read(whole):
    """The intact miniature is read: the broken cases fail for their own reason."""
    ((name, view, body),) = read_all(whole.parent)
    assert name == "CoreView_386_000000"
    assert view.image.shape == (64, 64, 3)
    assert view.mask.any()
    assert body.shape == (6890, 3)
    assert inside(view, body) > 0.9


@pytest.mark.parametrize("case", CASES)
def test_a_broken_one_gets_its_line(case, whole, tmp_path, monkeypatch):
    """Every defect is reported in one line that the documentation lists."""
    shutil.copytree(whole, tmp_path / "data" / NAME)
    monkeypatch.chdir(tmp_path)
    spoil, line = CASES[case]
    spoil(tmp_path / "data" / NAME)
    refused(line, lambda: read_all(tmp_path / "data"))


def test_problems_are_collected_where_that_is_asked_for(whole, tmp_path):
    """task=check reports all problems, and still reads what is intact."""
    for sequence in ("386", "387"):
        shutil.copytree(whole, tmp_path / f"CoreView_{sequence}")
    put("R", 2 * np.eye(3))(tmp_path / "CoreView_387")
    reader = build_data("zju_mocap", tmp_path).dataset.reader("train", strict=False)
    assert list(reader.subjects) == ["CoreView_386_000000"]
    assert [line.split(": ")[0] for line in reader.problems] == [
        str(tmp_path / "CoreView_387" / "annots.npy")
    ]


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("data.root=null", "data.root: expected the folder of the data set; found null"),
        ("data.root=/nowhere", "/nowhere: expected the folder of the data set; found no such folder"),
        (
            "data.split.train=[{sequences: [386], frames: [5, 5, 1]}]",
            r"data.split.train.frames: expected \[start, stop",
        ),
        ("data.split.train=[{sequences: [], frames: [0, 5, 1]}]", "split.train.sequences: expected a list"),
        ("data.split.train=[]", "data.split.train: expected a list"),
        (
            "data.split.train=[{sequence: [386], frames: [0, 5, 1]}]",
            "data.split.train key: expected one of frames, sequences; found 'sequence'",
        ),
        ("data.cameras=1", "data.cameras: expected an integer >= 2 or null; found 1"),
        ("data.cameras=24", "annots.npy: expected 24 cameras; found 23"),
        ("data.masks=[]", r"data.masks: expected a list \(each a text\); found \[\]"),
    ],
)
def test_impossible_settings_are_refused(whole, override, line):
    """A wrong value fails at once and names its key."""
    refused(line, lambda: build_data("zju_mocap", whole.parent, override).dataset.reader("train"))
