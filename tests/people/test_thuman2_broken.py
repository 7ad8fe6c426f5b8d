"""Reports of task=check about broken THuman2.0 data: one line for each defect, and no training."""

import json
import os
import pickle
import re
import shutil
from typing import ClassVar

import numpy as np
import pytest
from PIL import Image

from ghgs_lit.data.check import inspect
from ghgs_lit.errors import InputError
from ghgs_people.thuman2 import THuman2
from scripts.miniatures import thuman2 as miniature
from scripts.miniatures.scans import make_scans
from tests.data.test_pickles import Call
from tests.helpers.captures import truncate
from tests.helpers.people import V4

SIZE = 64
VIEW = "0000_002/3"


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """Renderings with 4 cameras and 2 views each, and the raw scans of the same people."""
    folder = tmp_path_factory.mktemp("sound")
    count = {"train": 1, "val": 1}
    miniature.make(folder / "root", count, SIZE, 0, vids=(0, 3), positions=4)
    make_scans(folder / "raw" / "THuman2.0_Release", count, 32, 0)
    return folder


@pytest.fixture
def folder(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "data")
    return tmp_path / "data"


class Small(THuman2):
    """The miniature has four cameras."""

    ring: ClassVar[int] = 4


def module(folder, **changes):
    arguments = {
        "root": str(folder / "root"),
        "size": SIZE,
        "workers": 0,
    }
    return Small(**{**arguments, **changes}).build(V4, {"name": "release", "training_views": [3]})


def change_array(path, change):
    np.save(path, change(np.load(path)))


def camera(folder, change, matrix="extrinsic"):
    change_array(folder / f"root/train/parm/{VIEW}_{matrix}.npy", change)


def with_nan(pose):
    pose[0, 3] = np.nan
    return pose


def camera_to_world(pose):
    return np.concatenate((pose[:, :3].T, -pose[:, :3].T @ pose[:, 3:]), 1)


def another_id(folder):
    for kind in ("img", "mask", "depth", "parm"):
        os.rename(folder / f"root/train/{kind}/0000_002", folder / f"root/train/{kind}/0009_002")


def body(folder, change):
    change_array(folder / "root/train/smpl/0000/vertices.npy", change)


RENDERED = {
    "photograph missing": (
        lambda f: (f / f"root/train/img/{VIEW}.jpg").unlink(),
        r"train/img/0000_002/3\.jpg: expected an image; found no such file",
    ),
    "photograph cut off": (
        lambda f: truncate(f / f"root/train/img/{VIEW}.jpg"),
        r"train/img/0000_002/3\.jpg: expected a readable image; found .*[Tt]runcated",
    ),
    "mask missing": (
        lambda f: (f / f"root/train/mask/{VIEW}.png").unlink(),
        r"train/mask/0000_002/3\.png: expected an image; found no such file",
    ),
    "mask empty": (
        lambda f: Image.new("RGB", (SIZE, SIZE)).save(f / f"root/train/mask/{VIEW}.png"),
        r"train/mask/0000_002/3\.png: expected a subject in the mask; found none$",
    ),
    "mask of another size": (
        lambda f: Image.new("L", (32, 16), 255).save(f / f"root/train/mask/{VIEW}.png"),
        r"train/mask/0000_002/3\.png: expected the size of its photograph, 64x64; found 16x32",
    ),
    "depth of 8 bits": (
        lambda f: Image.new("L", (SIZE, SIZE), 9).save(f / f"root/train/depth/{VIEW}.png"),
        r"train/depth/0000_002/3\.png: expected 16 bits of inverse depth; found 'uint8'",
    ),
    "camera missing": (
        lambda f: (f / f"root/train/parm/{VIEW}_extrinsic.npy").unlink(),
        r"3_extrinsic\.npy: expected an array 3x4 or 4x4; found no such file",
    ),
    "camera with NaN": (
        lambda f: camera(f, with_nan),
        r"3_extrinsic\.npy: expected finite numbers; found NaN or infinity",
    ),
    "R and T swapped": (
        lambda f: camera(f, lambda pose: np.concatenate((pose[:, 3:], pose[:, :3]), 1)),
        r"3_extrinsic\.npy: expected a rotation in the first three columns; found a mirrored axis in \[\[",
    ),
    "camera to world": (
        lambda f: camera(f, camera_to_world),
        r"3\.png: expected the body in its mask \(IoU of their boxes 0\.50 or more\); found 0\.",
    ),
    "camera in millimetres": (
        lambda f: camera(f, lambda pose: pose * [1, 1, 1, 1000]),
        r"3\.png: expected the body in its mask \(IoU of their boxes 0\.50 or more\); found 0\.",
    ),
    "intrinsics of another size": (
        lambda f: camera(f, lambda matrix: matrix * [[2], [2], [1]], "intrinsic"),
        r"3\.png: expected the body in its mask \(IoU of their boxes 0\.50 or more\); found 0\.",
    ),
    "no focal length": (
        lambda f: camera(f, lambda matrix: matrix * [[0], [1], [1]], "intrinsic"),
        r"3_intrinsic\.npy: expected focal lengths above 0; found 0\.0, ",
    ),
    "one position of another subject": (
        another_id,
        r"evaluation with 4 views: expected ring positions|ring positions of subject 0000 to draw",
    ),
    "body of another shape": (
        lambda f: body(f, lambda v: v[:, :2]),
        r"smpl/0000/vertices\.npy: expected an array nx3; found 13380x2",
    ),
    "body in millimetres": (
        lambda f: body(f, lambda v: 1000 * v),
        r"0000_000/0\.png: expected the body in its mask \(IoU of their boxes 0\.50 or more\); found 0\.",
    ),
    "no val": (
        lambda f: shutil.rmtree(f / "root/val"),
        r"root/val/img: expected a folder <id>_<position> for every camera; found no such folder",
    ),
}


def fit(folder, **changes):
    path = folder / "raw/THuman2.0_smplx/0000/smplx_param.pkl"
    content = {**pickle.loads(path.read_bytes()), **changes}
    path.write_bytes(pickle.dumps({key: value for key, value in content.items() if value is not None}))


def fitted_mesh(folder, change):
    path = folder / "raw/THuman2.0_smplx/0000/mesh_smplx.obj"
    vertices = change(np.array([line.split()[1:] for line in path.read_text().splitlines()], float))
    path.write_text("".join(f"v {x} {y} {z}\n" for x, y, z in vertices))


RAW = {
    "malicious fit": (
        lambda f: fit(f, betas=Call(os.system, "touch called")),
        r"0000/smplx_param\.pkl: expected a pickle of NumPy arrays and plain containers; found posix\.system",
    ),
    "fit cut off": (
        lambda f: truncate(f / "raw/THuman2.0_smplx/0000/smplx_param.pkl"),
        r"0000/smplx_param\.pkl: expected a readable pickle; found",
    ),
    "fit without rotation": (
        lambda f: fit(f, global_orient=None),
        r"0000/smplx_param\.pkl: expected the key 'global_orient'; found \['betas'",
    ),
    "fit with NaN": (
        lambda f: fit(f, global_orient=np.full(3, np.nan)),
        r"0000/smplx_param\.pkl: global_orient: expected finite numbers; found NaN or infinity",
    ),
    "fit of another scan missing": (
        lambda f: shutil.rmtree(f / "raw/THuman2.0_smplx/0000"),
        r"THuman2\.0_smplx/0000: expected the scan's SMPL-X fit; found no such folder",
    ),
    "fitted mesh missing": (
        lambda f: (f / "raw/THuman2.0_smplx/0000/mesh_smplx.obj").unlink(),
        r"0000/mesh_smplx\.obj: expected the fitted mesh; found no such file",
    ),
    "body not scaled": (
        lambda f: fitted_mesh(f, lambda v: v * 2),
        r"THuman2\.0_smplx/0000: expected a body in its scan's frame; found one 1\.9\d times as tall",
    ),
    "body not translated": (
        lambda f: fitted_mesh(f, lambda v: v + np.array([0.5, 0, 0])),
        r"THuman2\.0_smplx/0000: expected a body in its scan's frame; found one .* leaves its box by 0\.",
    ),
    "texture missing": (
        lambda f: (f / "raw/THuman2.0_Release/0000/material0.jpeg").unlink(),
        r"0000/0000\.obj: expected a texture for the mesh .*; found none",
    ),
    "scan is no mesh": (
        lambda f: (f / "raw/THuman2.0_Release/0000/0000.obj").write_text("f 1 2 3\n"),
        r"0000/0000\.obj: expected",
    ),
}


def test_sound_data_is_clean(folder, tmp_path, capsys):
    """Intact data has no problems; a line for each phase is printed and stored."""
    report = inspect(module(folder))
    assert report.problems == []
    assert report.notes == []
    assert [figures["photos"] for figures in report.phases.values()] == [8, 8]
    assert min(figures["least iou"] for figures in report.phases.values()) > 0.7
    report.show()
    assert "train: subjects 1, photos 8, broken 0, bodies 1, " in capsys.readouterr().out
    report.write(tmp_path / "check.json")
    content = json.loads((tmp_path / "check.json").read_text())
    assert content["problems"] == []
    assert content["phases"]["train"]["least iou"] > 0.7


@pytest.mark.parametrize("kind", RENDERED)
def test_broken_renders(folder, kind):
    """Each defect of a rendering is found by task=check and reported once."""
    damage, pattern = RENDERED[kind]
    damage(folder)
    problems = inspect(module(folder)).problems
    assert [line for line in problems if re.search(pattern, line)], problems
    assert all(re.fullmatch(".+: expected .+; found .+", line) for line in problems)
    # One defect, one line; a body or a subject is that of all its views.
    assert len(problems) == 1 or kind.startswith(("body", "one position"))


@pytest.mark.parametrize("kind", RAW)
def test_broken_scans(folder, kind, monkeypatch):
    """Each defect of a scan or fit stops its rendering with one line; code in pickles is not executed."""
    monkeypatch.chdir(folder)
    damage, pattern = RAW[kind]
    damage(folder)
    source = module(folder, source=str(folder / "raw/THuman2.0_Release")).dataset.scans()
    with pytest.raises(InputError, match=pattern) as caught:
        source.load("0000"), source.facing("0000")
    assert "\n" not in str(caught.value)
    assert not (folder / "called").exists()


def test_an_id_of_a_split_that_is_not_there(folder):
    """A split with a missing subject is reported and stops training."""
    split = {"train": ["0000", "0001"], "val": ["0426"]}
    line = f"{folder}/root/train/img: expected 2 whole subjects; found 1 (0001 is missing or half-rendered"
    (problem,) = inspect(module(folder, split=split)).problems
    assert problem.startswith(line)
    with pytest.raises(InputError, match=re.escape(line)):
        module(folder, split=split).training_batch(0)


def test_a_folder_of_fits_that_is_not_there(folder):
    """A wrong data.fits is reported instead of being ignored."""
    data = module(folder, source=str(folder / "raw/THuman2.0_Release"), fits=str(folder / "none"))
    with pytest.raises(
        InputError, match=r"none: expected the folder of the SMPL-X fits; found no such folder"
    ):
        data.dataset.scans()


def test_loading_processes_find_the_same(folder):
    """task=check reports the same with several workers."""
    RENDERED["mask empty"][0](folder)
    assert inspect(module(folder, workers=2)).problems == inspect(module(folder)).problems
