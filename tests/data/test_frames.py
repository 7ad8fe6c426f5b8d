"""Behaviour common to the readers of ZJU-MoCap and HuMMan-Recon, on miniatures."""

import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ghgs_lit.data.pickles import load_npy
from ghgs_lit.data.reader import Photographs
from ghgs_lit.data.sampling import CAMERAS
from ghgs_lit.errors import InputError
from scripts.miniatures import humman, zju_mocap
from tests.helpers.captures import (
    blob,
    build_data,
    centroid,
    make_miniature,
    project,
    require_same_packed,
    stored,
)

ZJU_SPLIT = "data.split={train: [{sequences: [386], FRAMES}], val: [{sequences: [SEQUENCE], FRAMES}]}"
#: By data set: folder of a sequence, paths of a camera's image and mask in it, and the camera's index.
CASES = {
    "zju_mocap": ("CoreView_386", "Camera_B8/000000.jpg", "mask_cihp/Camera_B8/000000.png", 7),
    "humman": ("p000455_a000986", *(f"kinect_{k}/kinect_007/000000.png" for k in ("color", "mask")), 7),
}
each = pytest.mark.parametrize("kind", CASES)


@pytest.fixture
def roots(zju_root, humman_root) -> dict[str, Path]:
    return {"zju_mocap": zju_root, "humman": humman_root}


def data(kind: str, root: Path, *overrides: str, sequence: str = "386"):
    split = (
        [ZJU_SPLIT.replace("SEQUENCE", sequence).replace("FRAMES", "frames: [0, 2, 1]")]
        if kind == "zju_mocap"
        else []
    )
    return build_data(kind, root, *split, *overrides, "data.workers=0")


def photographs(kind: str, root: Path, size=None, *overrides: str) -> Photographs:
    return stored(data(kind, root, *overrides), "val", size)


@each
def test_the_background_is_black(roots, kind):
    """The studio behind the performer must not be visible to the model."""
    overrides = ("data.undistorted=true", "data.undistorted=false") if kind == "zju_mocap" else ("seed=0",)
    for override in overrides:
        view = photographs(kind, roots[kind], None, override).view(f"{CASES[kind][0]}_000000", 2)
        assert view.image[~view.mask].max() == 0
        assert view.image[view.mask].max() > 60


def opencv_camera(kind: str, folder: Path, number: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stored K, R and T of a camera, T in metres."""
    if kind == "humman":
        camera = json.loads((folder / "cameras.json").read_text())[f"kinect_color_{number:03d}"]
        return tuple(np.array(camera[key]) for key in "KRT")
    cams = load_npy(folder / "annots.npy")["cams"]
    return cams["K"][number], cams["R"][number], cams["T"][number][:, 0] / 1000


@each
@pytest.mark.parametrize("share", [1, 2, 4])
def test_intrinsics_fit_resized_photographs(roots, tmp_path, kind, share):
    """A spot drawn where OpenCV's camera projects a point is where the view's camera projects it."""
    sequence, photograph, mask, number = CASES[kind]
    folder = shutil.copytree(roots[kind] / sequence, tmp_path / sequence)
    matrix, rotation, translation = opencv_camera(kind, folder, number)
    _, first, offset = opencv_camera(kind, folder, 0)
    point = first.T @ (np.array([0.03, 0.1, 2.4]) - offset)
    x, y, z = matrix @ (rotation @ point + translation)
    height, width = np.asarray(Image.open(folder / photograph)).shape[:2]
    Image.fromarray(blob(height, width, x / z, y / z)).save(folder / photograph, quality=100)
    Image.fromarray(np.full((height, width), 7, np.uint8)).save(folder / mask)
    size = (height // share, width // share)
    override = "data.undistorted=false" if kind == "zju_mocap" else "seed=0"
    view = photographs(kind, tmp_path, size, override).view(f"{sequence}_000000", number)
    assert view.image.shape == (*size, 3)
    np.testing.assert_allclose(centroid(view.image), project(view, point), atol=0.03)


@each
def test_targets_between_cameras_that_stand_still_are_refused(roots, kind):
    """Views that do not exist are rejected before anything is read."""
    module = data(kind, roots[kind], "targets=release")
    for draw in (
        module.training_sampler,
        module.evaluation_loader,
        partial(module.evaluation_loader, targets={"name": "midway"}),
    ):
        with pytest.raises(InputError, match=rf"targets: expected cameras for data={kind}.*; found"):
            draw()
    assert len(module.evaluation_loader(targets=CAMERAS)) > 0


@pytest.mark.parametrize("sequence", ["386", "313"])
def test_packed_frames_are_the_same(zju_root, tmp_path, sequence):
    """Distorted and undistorted images have separate packed files, for names of both generations."""
    for override in ("data.undistorted=true", "data.undistorted=false"):
        reader = data("zju_mocap", zju_root, override, sequence=sequence).dataset.reader("val")
        require_same_packed(reader, tmp_path, (64, 48))


@each
def test_the_same_numbers_make_the_same_miniature(roots, tmp_path, kind):
    """A miniature is reproducible, whatever other miniatures are made."""
    sequence, *files, _ = CASES[kind]
    if kind == "zju_mocap":
        make_miniature(zju_mocap, tmp_path / "root", ["386"], 112, seed=3, frames=1)
    else:
        make_miniature(humman, tmp_path / "root", [sequence], {"train": 1, "val": 0}, 160, seed=3, frames=[0])
        sequence = "p100001_a000048"
    for name in files:
        place = Path(sequence) / name
        assert (tmp_path / "root" / place).read_bytes() == (roots[kind] / place).read_bytes()
