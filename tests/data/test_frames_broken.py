"""Broken sequences of ZJU-MoCap and HuMMan-Recon: each defect raises one line with its place, what was
expected and what was found.

The lines are listed in ``docs/evidence/broken_files.md``.
"""

import json
import pickle
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from ghgs_lit.data.humman import read_model, read_parameters
from ghgs_lit.data.pickles import load_npy
from scripts.miniatures import humman, zju_mocap
from scripts.miniatures.smpl import stand_in
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

NAMES = {"zju_mocap": "CoreView_386", "humman": "p000455_a000986"}
ZJU_IMAGE, ZJU_MASK = "Camera_B1/000000.jpg", "mask_cihp/Camera_B1/000000.png"
HUMMAN_IMAGE, HUMMAN_MASK = (f"kinect_{kind}/kinect_000/000000.png" for kind in ("color", "mask"))


def change_annotations(change):
    """A case that changes the content of ``annots.npy``."""

    def apply(folder: Path) -> None:
        content = load_npy(folder / "annots.npy")
        change(content)
        np.save(folder / "annots.npy", content)

    return apply


def put_lens(kind: str, value):
    """A case that replaces K, R, T or D of the fourth camera."""
    return change_annotations(lambda content: content["cams"][kind].__setitem__(3, value))


def swap(content: dict) -> None:
    cams = content["cams"]
    cams["R"], cams["T"] = cams["T"], cams["R"]


def convert_to_metres(content: dict) -> None:
    content["cams"]["T"] = [t / 1000 for t in content["cams"]["T"]]


def drop_cameras(content: dict) -> None:
    for values in (*content["cams"].values(), *(frame["ims"] for frame in content["ims"])):
        del values[19:]


def rename_photograph(value: str):
    return change_annotations(lambda content: content["ims"][0]["ims"].__setitem__(2, value))


def replace_body(value):
    return lambda folder: np.save(folder / "new_vertices" / "0.npy", value)


def change_calibration(change):
    """A case that changes the content of ``cameras.json``."""

    def apply(folder: Path) -> None:
        content = json.loads((folder / "cameras.json").read_text())
        change(content)
        (folder / "cameras.json").write_text(json.dumps(content))

    return apply


def put_kinect(key: str, value):
    """A case that replaces K, R or T of the fourth colour camera."""
    return change_calibration(lambda content: content["kinect_color_003"].__setitem__(key, value))


def swap_kinects(content: dict) -> None:
    for camera in content.values():
        camera["R"], camera["T"] = camera["T"], camera["R"]


def move(content: dict, factor: float) -> None:
    for camera in content.values():
        camera["T"] = [factor * t for t in camera["T"]]


def renumber(folder: Path) -> None:
    for path in folder.glob("kinect_*/kinect_*/000000.png"):
        path.rename(path.with_name("000001.png"))


def of_photographs(image: str, mask: str, size: str, shrunk: str) -> dict:
    """Cases of a broken image and mask of any sequence."""
    name = Path(image).name
    resized = f"{name}: expected a photograph of the calibration's size, .*; found {shrunk}"
    return {
        "truncated photograph": (
            lambda f: truncate(f / image),
            f"{name}: expected a readable image; found",
        ),
        "resized photograph": (lambda f: [shrink(f / each) for each in (image, mask)], resized),
        "no mask": (lambda f: (f / mask).unlink(), f"{mask}: expected an image; found no such"),
        "mask of another size": (
            lambda f: shrink(f / mask),
            f"000000.png: expected the size of its photograph, {size}; found {shrunk}",
        ),
        "empty mask": (lambda f: blank(f / mask), f"{mask}: expected a subject in the mask; found"),
    }


ZJU_MOCAP = {
    **of_photographs(ZJU_IMAGE, ZJU_MASK, "64x64", "32x32"),
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
        change_annotations(lambda c: c.pop("cams")),
        r"annots.npy: expected an entry 'cams'; found \['ims'\]",
    ),
    "R and T swapped": (
        change_annotations(swap),
        r"annots.npy: camera 0: R: expected an array 3x3; found 3x1",
    ),
    "fewer cameras": (
        change_annotations(drop_cameras),
        r"annots.npy: expected 20 cameras; found 19",
    ),
    "fewer lenses": (
        change_annotations(lambda c: c["cams"]["D"].pop()),
        r"expected as many K, D, R and T .* 'D': 22",
    ),
    "NaN camera": (
        put_lens("R", np.full((3, 3), np.nan)),
        r"camera 3: R: expected finite numbers; found NaN or infinity",
    ),
    "no rotation": (
        put_lens("R", 2 * np.eye(3)),
        r"camera 3: expected a rotation in the first three columns; found",
    ),
    "mirrored camera": (
        put_lens("R", np.diag([1.0, 1, -1])),
        r"camera 3: expected a rotation in the first three columns",
    ),
    "focal length 0": (
        put_lens("K", np.diag([0.0, 1, 1])),
        r"camera 3: K: expected focal lengths above 0; found 0.0, 1.0",
    ),
    "lens of 3 numbers": (put_lens("D", np.zeros((3, 1))), r"camera 3: D: expected an array 4 or 5; found 3"),
    "metres": (
        change_annotations(convert_to_metres),
        r"expected translations T in millimetres; found cameras within \d+ mm .*metres",
    ),
    "a camera less in a frame": (
        change_annotations(lambda c: c["ims"][0]["ims"].pop()),
        r"frame 0: expected a photograph for each of 23 cameras; found 22",
    ),
    "wrong frame number": (
        rename_photograph("Camera_B3/000001.jpg"),
        r"frame 0: expected one frame number for all cameras; found \['000000', '000001'\]",
    ),
    "name without a number": (
        change_annotations(
            lambda c: c["ims"].__setitem__(0, {"ims": [f"Camera_B{k}/first.jpg" for k in range(1, 24)]})
        ),
        r"Camera_B1/first.jpg: expected a frame number, .*; found 'first.jpg'",
    ),
    "path that leaves": (
        rename_photograph("../../secret/000000.jpg"),
        r"frame 0: expected paths below the sequence; found '../../secret/000000.jpg'",
    ),
    "no photograph": (
        lambda f: (f / ZJU_IMAGE).unlink(),
        r"CoreView_386/Camera_B1/000000.jpg: expected an image; found no such file",
    ),
    "no folder of masks": (
        lambda f: shutil.rmtree(f / "mask_cihp"),
        f"{ZJU_MASK}: expected an image; found no",
    ),
    "truncated mask": (lambda f: truncate(f / ZJU_MASK), r"000000.png: expected a readable image; found"),
    "body of another model": (
        replace_body(np.zeros((10475, 3))),
        r"0.npy: expected an array 6890x3; found 10475x3",
    ),
    "malicious body": (
        replace_body(np.array(Malice(), object)),
        r"0.npy: expected an array 6890x3; found a file that cannot",
    ),
    "NaN body": (
        replace_body(np.full((6890, 3), np.nan)),
        r"0.npy: expected finite numbers; found NaN or infinity",
    ),
    "no sequence": (shutil.rmtree, r"expected sequences such as CoreView_386; found none of train"),
}

HUMMAN = {
    **of_photographs(HUMMAN_IMAGE, HUMMAN_MASK, "72x128", "36x64"),
    "no cameras": (
        lambda f: (f / "cameras.json").unlink(),
        r"cameras.json: expected the cameras .*; found no such file",
    ),
    "truncated cameras": (lambda f: truncate(f / "cameras.json"), r"cameras.json: expected the cameras"),
    "a camera missing": (
        change_calibration(lambda c: c.pop("kinect_color_007")),
        r"cameras.json: kinect_color_007: expected K; found none",
    ),
    "no T": (
        change_calibration(lambda c: c["kinect_color_003"].pop("T")),
        r"kinect_color_003: expected T; found none",
    ),
    "R and T swapped": (
        change_calibration(swap_kinects),
        r"kinect_color_000: R: expected an array 3x3; found 3",
    ),
    "NaN camera": (
        put_kinect("T", [float("nan")] * 3),
        r"kinect_color_003: T: expected finite numbers; found NaN",
    ),
    "no rotation": (
        put_kinect("R", [[2, 0, 0], [0, 1, 0], [0, 0, 1]]),
        r"kinect_color_003: expected a rotation in",
    ),
    "focal length below 0": (
        put_kinect("K", [[-5, 0, 1], [0, 5, 1], [0, 0, 1]]),
        r"expected focal lengths above 0; found -5",
    ),
    "text for a matrix": (
        put_kinect("K", "none"),
        r"kinect_color_003: K: expected an array 3x3; found text",
    ),
    "millimetres": (
        change_calibration(lambda c: move(c, 1000)),
        r"expected translations T in metres; found cameras \d+ m apart",
    ),
    "all cameras in one place": (
        change_calibration(lambda c: move(c, 0)),
        r"expected translations T in metres; found cameras 0 m",
    ),
    "no photographs": (
        lambda f: shutil.rmtree(f / "kinect_color"),
        r"kinect_color: expected frames such as 000000.png; found none of 17 .*multiples of 6",
    ),
    "wrong frame numbers": (renumber, r"kinect_color: expected frames such as 000000.png; found none of 17"),
    "no sequence": (shutil.rmtree, r"expected sequences such as p000455_a000986; found none of val"),
}

CASES = [("zju_mocap", *case) for case in ZJU_MOCAP.values()]
CASES += [("humman", *case) for case in HUMMAN.values()]
IDS = [f"zju_mocap {name}" for name in ZJU_MOCAP] + [f"humman {name}" for name in HUMMAN]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> dict[str, Path]:
    """Folder of a miniature with one frame for each data set."""
    roots = {name: tmp_path_factory.mktemp(name) / "data" for name in NAMES}
    make_miniature(zju_mocap, roots["zju_mocap"], ["386"], 64, seed=3, frames=1)
    arguments = [NAMES["humman"]], {"train": 0, "val": 1}, 128
    make_miniature(humman, roots["humman"], *arguments, seed=3, frames=[0])
    return roots


def read_all(kind: str, root: Path) -> list:
    """Read everything of the frame that training or evaluation reads."""
    settings = ("train", ("data.size=64",)) if kind == "zju_mocap" else ("val", ())
    photographs = stored(build_data(kind, root, *settings[1]), settings[0])
    return [
        (name, photographs.view(name, 0), photographs.reader.read_checked_body(name))
        for name in photographs.reader.subjects
    ]


@pytest.mark.parametrize(("kind", "size"), [("zju_mocap", (64, 64)), ("humman", (72, 128))])
def test_the_whole_one_is_read(whole, kind, size):
    """The intact miniature can be read, so that broken ones fail for their own reason."""
    ((name, view, body),) = read_all(kind, whole[kind])
    assert name == f"{NAMES[kind]}_000000"
    assert view.image.shape == (*size, 3)
    assert view.mask.any()
    assert body is None or inside(view, body) > 0.9


@pytest.mark.parametrize(("kind", "spoil", "line"), CASES, ids=IDS)
def test_a_broken_one_gets_its_line(kind, spoil, line, whole, tmp_path, monkeypatch):
    """Each defect raises one line, which the documentation lists."""
    folder = shutil.copytree(whole[kind] / NAMES[kind], tmp_path / "data" / NAMES[kind])
    monkeypatch.chdir(tmp_path)
    spoil(folder)
    refused(line, lambda: read_all(kind, tmp_path / "data"))


ZJU_SETTINGS = [
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
        "data.split.train.sequence: expected one of frames, sequences; found 'sequence'",
    ),
]
HUMMAN_SETTINGS = [
    (
        "data.smpl_model=/nowhere",
        "/nowhere: expected SMPL_NEUTRAL.pkl, or a folder with smpl/SMPL_NEUTRAL.pkl",
    ),
    ("data.split.val=[]", r"data.split.val: expected a list \(each a text\); found \[\]"),
    ("data.split.val=null", r"data.split.val: expected a list \(each a text\); found None"),
]
SETTINGS = [("zju_mocap", "train", *case) for case in ZJU_SETTINGS]
SETTINGS += [("humman", "val", *case) for case in HUMMAN_SETTINGS]


@pytest.mark.parametrize(("kind", "phase", "override", "line"), SETTINGS)
def test_impossible_settings_are_refused(whole, kind, phase, override, line):
    """A wrong value is rejected at once, with its key."""
    refused(line, lambda: build_data(kind, whole[kind], override).dataset.reader(phase))


def test_without_smplx_the_message_says_what_to_install(whole, monkeypatch):
    """A missing optional package is reported with the command to install it."""
    monkeypatch.setitem(sys.modules, "smplx", None)
    place = whole["humman"].with_name("data_body_models")
    data = build_data("humman", whole["humman"], f"data.smpl_model={place}").dataset
    refused(
        r"data.smpl_model: expected the package smplx .*pip install 'ghgs-lit\[smpl\]'",
        lambda: data.reader("val"),
    )


GOOD = {"betas": np.zeros(10), "body_pose": np.zeros(69), "global_orient": np.zeros(3), "transl": np.zeros(3)}


def write_parameters(**changes):
    return lambda path: np.savez(path, **{k: v for k, v in {**GOOD, **changes}.items() if v is not None})


def write_model(content):
    return lambda path: path.write_bytes(pickle.dumps(content))


def write_half(path: Path) -> None:
    np.savez(path, **GOOD)
    truncate(path)


SMPL = {
    "malicious": (
        "0.npz",
        write_parameters(betas=np.array(Malice(), object)),
        "expected an .npz file of arrays; found",
    ),
    "without transl": ("0.npz", write_parameters(transl=None), "expected transl; found"),
    "of SMPL-X": (
        "0.npz",
        write_parameters(body_pose=np.zeros(63)),
        "body_pose: expected an array 69; found 63",
    ),
    "NaN": (
        "0.npz",
        write_parameters(transl=np.full(3, np.nan)),
        "transl: expected finite numbers; found NaN or infinity",
    ),
    "missing": ("0.npz", lambda path: None, "expected SMPL parameters; found no such file"),
    "truncated": ("0.npz", write_half, "expected an .npz file of arrays; found"),
    "malicious model": (
        "a.pkl",
        write_model({**stand_in(), "f": Malice()}),
        "expected a pickle of NumPy arrays and plain containers; found posix.system",
    ),
    "model of SMPL-X": (
        "a.pkl",
        write_model({**stand_in(), "v_template": np.zeros((10475, 3))}),
        "v_template: expected an array 6890x3; found 10475x3",
    ),
    "a list": ("a.pkl", write_model([1, 2]), "expected the arrays of an SMPL model; found list"),
}


@pytest.mark.parametrize("case", SMPL)
def test_broken_files_of_smpl_get_their_line(case, tmp_path, monkeypatch):
    """Bad parameters and models are named and never executed."""
    monkeypatch.chdir(tmp_path)
    name, write, line = SMPL[case]
    write(tmp_path / name)
    read = read_model if name == "a.pkl" else read_parameters
    refused(f"{name}.*{line}", lambda: read(tmp_path / name))
