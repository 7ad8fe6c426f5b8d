"""HuMMan-Recon: every oddity of the format, on a miniature in its true layout."""

import pickle
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import sparse

from ghgs_lit.data.humman import HuMMan
from ghgs_lit.data.reader import Photographs
from ghgs_lit.data.smpl import read_model
from scripts.miniatures.smpl import stand_in
from tests.helpers.captures import (
    build_data,
    inside,
    require_same_packed,
)

TEST = "p000455_a000986"
WIDTH, HEIGHT = 160, 90


def photographs(root: Path, size=None, **options) -> Photographs:
    data = HuMMan(root=root, split={"val": [TEST]}, frames=(0, 97, 6), **options)
    return Photographs(data.reader("val"), size)


def test_frames_are_multiples_of_6_and_some_lack(humman_root):
    """Frames that a sequence lacks are left out; all ten cameras are positions."""
    assert list(photographs(humman_root).reader.subjects) == [f"{TEST}_{n:06d}" for n in (0, 6, 18)]
    assert set(photographs(humman_root).reader.subjects.values()) == {tuple(range(10))}


def test_a_camera_that_lacks_a_frame_is_left_out(humman_root, tmp_path):
    """A missing photograph removes one camera from one frame, not the frame."""
    shutil.copytree(humman_root / TEST, tmp_path / TEST)
    (tmp_path / TEST / "kinect_color" / "kinect_004" / "000006.png").unlink()
    subjects = photographs(tmp_path).reader.subjects
    assert subjects[f"{TEST}_000006"] == (0, 1, 2, 3, 5, 6, 7, 8, 9)
    assert subjects[f"{TEST}_000018"] == tuple(range(10))


def test_named_sequences_are_for_testing_and_the_rest_for_training(humman_root, tmp_path):
    """The official test sequences never reach training."""
    shutil.copytree(humman_root, tmp_path / "recon")
    (tmp_path / "recon" / "notes").mkdir()
    data = build_data("humman", tmp_path / "recon").dataset
    assert len(data.split.val) == len(set(data.split.val)) == 22
    assert data.sequences("train") == ["p100001_a000048"]
    assert {frame.folder.name for frame in data.reader("val").frames.values()} == {TEST}
    assert data.published == {"train": 317, "val": 22}
    assert list(range(*data.frames)) == [6 * i for i in range(17)]


def test_any_value_of_the_matting_is_the_performer(humman_root):
    """Soft values of the matting count as the performer, too."""
    path = humman_root / TEST / "kinect_mask" / "kinect_002" / "000006.png"
    matting = np.asarray(Image.open(path))
    assert ((matting > 0) & (matting < 128)).any()
    np.testing.assert_array_equal(photographs(humman_root).view(f"{TEST}_000006", 2).mask, matting > 0)


def test_drawn_masks_are_read_where_there_are_any(humman_root):
    """The option data.masks selects another folder, which only test sequences have."""
    view = photographs(humman_root, masks="kinect_mask_manual").view(f"{TEST}_000006", 2)
    assert view.mask.sum() < photographs(humman_root).view(f"{TEST}_000006", 2).mask.sum()
    assert not (humman_root / "p100001_a000048" / "kinect_mask_manual").exists()


def test_no_body_is_a_choice(humman_root):
    """Without a body a batch says so, and training without Chamfer loss is possible."""
    assert photographs(humman_root).body(f"{TEST}_000000") is None
    batch = build_data("humman", humman_root, "data.size=[36,64]", "data.workers=0").training_batch(0)
    assert batch.body_vertices is None
    assert batch.images.shape == (1, 4, 3, 36, 64)


def test_evaluation_takes_evenly_spaced_inputs_and_all_other_targets(humman_root):
    """The documented protocol: inputs 0 3 6 and seven targets; frames are not people."""
    data = build_data("humman", humman_root, "data.size=[36,64]", "data.workers=0")
    samples = list(data.evaluation_loader(views=3))
    assert len(samples) == 3
    assert samples[0].views == (("000/0", "003/0", "006/0"),)
    targets, others = samples[0].targets, (1, 2, 4, 5, 7, 8, 9)
    assert targets.names == (tuple(f"{k:03}/0" for k in others),)
    views = [photographs(humman_root, size=(36, 64)).view(f"{TEST}_000000", k) for k in others]
    images = (255 * targets.images[0].movedim(1, -1)).round()
    np.testing.assert_array_equal(images, [view.image for view in views])
    np.testing.assert_array_equal(targets.cameras.extrinsics[0], [view.extrinsics for view in views])
    assert data.dataset.reader("val").people == 1


def test_smpl_vertices_project_into_every_mask(humman_root):
    """Model, parameters and cameras agree about where the body is."""
    pytest.importorskip("smplx")
    data = photographs(humman_root, smpl_model=humman_root.with_name("recon_body_models"))
    for name in data.reader.subjects:
        assert data.body(name).shape == (6890, 3)
        assert min(inside(data.view(name, k), data.body(name)) for k in range(10)) > 0.97


def test_smpl_turns_about_the_pelvis_and_then_shifts(humman_root):
    """The order of rotation and translation is SMPL's."""
    pytest.importorskip("smplx")
    from ghgs_lit.data.smpl import Body

    body, model = Body(humman_root.with_name("recon_body_models")), stand_in()
    still = {
        "betas": np.zeros(10),
        "body_pose": np.zeros(69),
        "global_orient": np.zeros(3),
        "transl": np.zeros(3),
    }
    rest = body.vertices(still)
    np.testing.assert_allclose(rest, model["v_template"], atol=1e-5)
    turned = body.vertices(
        {**still, "global_orient": np.array([0, np.pi, 0]), "transl": np.array([1.0, 2, 3])}
    )
    pelvis = model["J_regressor"][0] @ model["v_template"]
    np.testing.assert_allclose(turned, (rest - pelvis) * [-1, 1, -1] + pelvis + [1, 2, 3], atol=1e-5)


class Ch:
    """As chumpy's arrays are pickled: an object with its array under ``x``."""

    def __init__(self, x):
        self.x = x


@pytest.mark.parametrize("protocol", [0, 2])
def test_pickles_of_the_official_release_are_read_without_chumpy(tmp_path, monkeypatch, protocol):
    """Users of the official file need no package that no longer installs."""
    module = type(sys)("chumpy.ch")
    module.Ch, Ch.__module__, Ch.__qualname__ = Ch, "chumpy.ch", "Ch"
    monkeypatch.setitem(sys.modules, "chumpy", type(sys)("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    arrays = stand_in()
    content = {
        **arrays,
        "shapedirs": Ch(arrays["shapedirs"]),
        "J_regressor": sparse.csc_matrix(arrays["J_regressor"]),
        "bs_type": "lrotmin",
    }
    path = tmp_path / "SMPL_NEUTRAL.pkl"
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    monkeypatch.delitem(sys.modules, "chumpy.ch")
    read = read_model(path)
    for key, value in arrays.items():
        np.testing.assert_allclose(read[key], value)


def test_packed_frames_are_the_same(humman_root, tmp_path):
    require_same_packed(photographs(humman_root).reader, tmp_path, (36, 64))
