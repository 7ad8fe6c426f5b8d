"""Broken HuMMan-Recon data: each case gets one line that says where,
what was expected and what was found.

The lines are listed in ``docs/evidence/broken_files.md``.
"""

import json
import pickle
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

from ghgs_lit.data.smpl import read_model, read_parameters
from scripts.miniatures import humman
from scripts.miniatures.smpl import stand_in
from tests.helpers.captures import (
    Malice,
    blank,
    build_data,
    make_miniature,
    refused,
    shrink,
    stored,
    truncate,
)

NAME = "p000455_a000986"
COLOR, MASK = (f"kinect_{kind}/kinect_000/000000.png" for kind in ("color", "mask"))


def calibrated(change):
    """A case that changes what is in ``cameras.json``."""

    def apply(folder: Path) -> None:
        content = json.loads((folder / "cameras.json").read_text())
        change(content)
        (folder / "cameras.json").write_text(json.dumps(content))

    return apply


def put(key: str, value):
    """A case that gives the fourth colour camera another K, R or T."""
    return calibrated(lambda content: content["kinect_color_003"].__setitem__(key, value))


def swap(content: dict) -> None:
    for camera in content.values():
        camera["R"], camera["T"] = camera["T"], camera["R"]


def millimetres(content: dict) -> None:
    for camera in content.values():
        camera["T"] = [1000 * t for t in camera["T"]]


def together(content: dict) -> None:
    for camera in content.values():
        camera["T"] = [0, 0, 0]


def renumber(folder: Path) -> None:
    for path in folder.glob("kinect_*/kinect_*/000000.png"):
        path.rename(path.with_name("000001.png"))


CASES = {
    "no cameras": (
        lambda f: (f / "cameras.json").unlink(),
        r"cameras.json: expected the cameras .*; found no such file",
    ),
    "truncated cameras": (lambda f: truncate(f / "cameras.json"), r"cameras.json: expected the cameras"),
    "a camera missing": (
        calibrated(lambda c: c.pop("kinect_color_007")),
        r"cameras.json: kinect_color_007: expected K; found none",
    ),
    "no T": (
        calibrated(lambda c: c["kinect_color_003"].pop("T")),
        r"kinect_color_003: expected T; found none",
    ),
    "R and T swapped": (calibrated(swap), r"kinect_color_000: R: expected an array 3x3; found 3"),
    "NaN camera": (put("T", [float("nan")] * 3), r"kinect_color_003: T: expected finite numbers; found NaN"),
    "no rotation": (put("R", [[2, 0, 0], [0, 1, 0], [0, 0, 1]]), r"kinect_color_003: expected a rotation in"),
    "focal length below 0": (
        put("K", [[-5, 0, 1], [0, 5, 1], [0, 0, 1]]),
        r"expected focal lengths above 0; found -5",
    ),
    "text for a matrix": (
        put("K", "none"),
        r"kinect_color_003: K: expected an array 3x3; found text",
    ),
    "millimetres": (
        calibrated(millimetres),
        r"expected translations T in metres; found cameras \d+ m apart",
    ),
    "all cameras in one place": (
        calibrated(together),
        r"expected translations T in metres; found cameras 0 m",
    ),
    "no photographs": (
        lambda f: shutil.rmtree(f / "kinect_color"),
        r"kinect_color: expected frames such as 000000.png; found none of 17 .*multiples of 6",
    ),
    "wrong frame numbers": (renumber, r"kinect_color: expected frames such as 000000.png; found none of 17"),
    "truncated photograph": (lambda f: truncate(f / COLOR), r"000000.png: expected a readable image; found"),
    "resized photograph": (
        lambda f: (shrink(f / COLOR), shrink(f / MASK)),
        r"kinect_000/000000.png: expected a photograph of the calibration's size, .*; found 36x64",
    ),
    "no mask": (
        lambda f: (f / MASK).unlink(),
        r"kinect_mask/kinect_000/000000.png: expected an image; found no such",
    ),
    "mask of another size": (
        lambda f: shrink(f / MASK),
        r"000000.png: expected the size of its photograph, 72x128; found 36x64",
    ),
    "empty mask": (
        lambda f: blank(f / MASK),
        r"kinect_mask/kinect_000/000000.png: expected a subject in the mask; found",
    ),
    "no sequence": (shutil.rmtree, r"expected sequences such as p000455_a000986; found none of val"),
}


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("whole") / "recon"
    make_miniature(humman, folder, [NAME], {"train": 0, "val": 1}, 128, seed=3, frames=[0])
    return folder / NAME


def read_all(root: Path) -> list:
    """What evaluation reads of the frame."""
    photographs = stored(build_data("humman", root), "val", (72, 128))
    return [(name, photographs.view(name, 0)) for name in photographs.reader.subjects]


def test_the_whole_one_is_read(whole):
    """The intact miniature is read: the broken cases fail for their own reason."""
    ((name, view),) = read_all(whole.parent)
    assert name == f"{NAME}_000000"
    assert view.image.shape == (72, 128, 3)
    assert view.mask.any()


@pytest.mark.parametrize("case", CASES)
def test_a_broken_one_gets_its_line(case, whole, tmp_path, monkeypatch):
    """Every defect is reported in one line that the documentation lists."""
    shutil.copytree(whole, tmp_path / NAME)
    monkeypatch.chdir(tmp_path)
    spoil, line = CASES[case]
    spoil(tmp_path / NAME)
    refused(line, lambda: read_all(tmp_path))


GOOD = {"betas": np.zeros(10), "body_pose": np.zeros(69), "global_orient": np.zeros(3), "transl": np.zeros(3)}
PARAMETERS = {
    "malicious": ({**GOOD, "betas": np.array(Malice(), object)}, "expected an .npz file of arrays; found"),
    "without transl": ({k: v for k, v in GOOD.items() if k != "transl"}, "expected transl; found"),
    "of SMPL-X": ({**GOOD, "body_pose": np.zeros(63)}, "body_pose: expected an array 69; found 63"),
    "NaN": ({**GOOD, "transl": np.full(3, np.nan)}, "transl: expected finite numbers; found NaN or infinity"),
}


@pytest.mark.parametrize("case", PARAMETERS)
def test_broken_parameters_get_their_line(case, tmp_path, monkeypatch):
    """Bad SMPL parameters are named and never executed."""
    monkeypatch.chdir(tmp_path)
    content, line = PARAMETERS[case]
    np.savez("000000.npz", **content)
    refused(f"000000.npz.*{line}", lambda: read_parameters(tmp_path / "000000.npz"))


def test_missing_and_truncated_parameters_get_their_line(tmp_path):
    """A missing or cut-off file is named."""
    path = tmp_path / "000000.npz"
    refused(r"000000.npz: expected SMPL parameters; found no such file", lambda: read_parameters(path))
    np.savez(path, **GOOD)
    truncate(path)
    refused(r"000000.npz: expected an .npz file of arrays; found", lambda: read_parameters(path))


MODELS = {
    "malicious": (
        {**stand_in(), "f": Malice()},
        "expected a pickle of NumPy arrays and plain containers; found posix.system",
    ),
    "of SMPL-X": (
        {**stand_in(), "v_template": np.zeros((10475, 3))},
        "v_template: expected an array 6890x3; found 10475x3",
    ),
    "a list": ([1, 2], "expected the arrays of an SMPL model; found list"),
}


@pytest.mark.parametrize("case", MODELS)
def test_a_broken_model_gets_its_line(case, tmp_path, monkeypatch):
    """A wrong model file is named and never executed."""
    monkeypatch.chdir(tmp_path)
    content, line = MODELS[case]
    Path("SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(content))
    refused(f"SMPL_NEUTRAL.pkl: {line}", lambda: read_model(tmp_path / "SMPL_NEUTRAL.pkl"))


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (
            ["data.smpl_model=/nowhere"],
            "/nowhere: expected SMPL_NEUTRAL.pkl, or a folder with smpl/SMPL_NEUTRAL.pkl",
        ),
        (["data.masks=mask"], "data.masks: expected one of kinect_mask, kinect_mask_manual; found 'mask'"),
        (["data.frames=[0,0,6]"], r"data.frames: expected \[start, stop, step\] with start < stop; found"),
        (["data.split.val=[]"], r"data.split.val: expected a list \(each a text\); found \[\]"),
        (["data.split.val=null"], r"data.split.val: expected a list \(each a text\); found None"),
    ],
)
def test_impossible_settings_are_refused(whole, overrides, line):
    """A wrong value fails at once and names its key."""
    refused(line, lambda: build_data("humman", whole.parent, *overrides).dataset.reader("val"))


def test_without_smplx_the_message_says_what_to_install(whole, monkeypatch):
    """A missing optional package is reported with how to get it."""
    monkeypatch.setitem(sys.modules, "smplx", None)
    place = whole.parent.with_name("recon_body_models")
    data = build_data("humman", whole.parent, f"data.smpl_model={place}").dataset
    refused(
        r"data.smpl_model: expected the package smplx .*pip install 'ghgs-lit\[smpl\]'",
        lambda: data.reader("val"),
    )
