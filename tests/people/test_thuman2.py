"""THuman2.0 on miniatures in its original layout, with one test for each pitfall of a loader."""

import shutil

import numpy as np
import pytest

from ghgs_lit.config import build, compose
from ghgs_lit.data.sampling import subject_rng
from ghgs_people import figures
from ghgs_people.figures.mesh import Person
from ghgs_people.lights import Lights
from ghgs_people.photograph import Studio
from ghgs_people.rig import Rig
from ghgs_people.thuman2 import THuman2, THuman2Source, find_fits
from scripts.miniatures import thuman2 as miniature
from scripts.miniatures.scans import make_scans, scan_of
from tests.helpers.captures import camera_of, stored
from tests.helpers.people import V4

SIZE = 96
COUNT = {"train": 1, "val": 1}
RELEASE = {"name": "release", "training_views": [2, 3, 4]}


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Renderings as by the published scripts: one person per phase, all 16 x 5 views."""
    return miniature.make(tmp_path_factory.mktemp("thuman2"), COUNT, SIZE, 0)


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    return make_scans(tmp_path_factory.mktemp("raw") / "THuman2.0_Release", COUNT, 64, 0)


def module(root=None, **changes):
    return THuman2(**{"root": root, "size": SIZE, "workers": 0, **changes}).build(V4, RELEASE)


def seen_by(view) -> np.ndarray:
    """Mask of the miniature's person 0000 from the camera that was read."""
    rng = subject_rng(0, "0000")
    scan = scan_of("0000", 0)
    person = Rig().place(Person("0000", (scan.mesh,), None), rng)
    return Studio(person, Lights().draw(rng), samples=2).shoot(camera_of(view)[None]).masks[0]


def test_published_renders_have_integer_pixel_centres(rendered):
    """The person rendered from the camera that was read covers exactly the mask; half a pixel off, it does
    not."""
    view = stored(module(rendered), "train").view("0000", 2, 3)
    np.testing.assert_array_equal(seen_by(view), view.mask)
    ignored = stored(module(rendered, pixel_centers="half"), "train").view("0000", 2, 3)
    assert (seen_by(ignored) != ignored.mask).sum() > 20


def test_own_renders_have_half_pixel_centres(raw, tmp_path):
    """pixel_centers=auto does not change the centres of our own renderings."""
    render = {"size": 48, "samples": 1, "views": (0, 3), "positions": (0, 1, 2, 3)}
    data = module(str(tmp_path), source=str(raw), render=render, render_workers=0)
    data.dataset.make()
    K = stored(data, "train").view("0000", 0, 0).intrinsics
    np.testing.assert_allclose(K[:2, 2], [24, 24 + 48 * 25 / 1024], atol=1e-5)


def test_the_first_camera_faces_the_person(raw):
    """global_orient of the fit turns the ring, so that a person with another orientation is seen from the
    front."""
    source = THuman2Source(raw, find_fits(raw, None))
    for name in ("0000", "0426"):
        scan = scan_of(name, 0)
        assert np.cos(np.radians(source.facing(name)) - scan.yaw) == pytest.approx(1, abs=1e-10)
    front = figures.generate(0, 0).body_vertices
    person = source.load("0000")
    turn = np.radians(source.facing("0000"))
    back = np.array([[np.cos(turn), 0, -np.sin(turn)], [0, 1, 0], [np.sin(turn), 0, np.cos(turn)]])
    turned = person.body_vertices @ back.T
    ratio = np.ptp(turned, axis=0) / np.ptp(front, axis=0)
    np.testing.assert_allclose(ratio, ratio[1], rtol=1e-3)


@pytest.mark.parametrize("name", ["THuman2.0_smplx", "THuman2.0_Smpl_X_Paras", "smplx_2", "smplx"])
def test_folders_of_fits_go_by_several_names(raw, tmp_path, name):
    """Fits are found under every published folder name."""
    beside, inside = tmp_path / "a" / "scans", tmp_path / "b" / "scans"
    for scans, fits in ((beside, beside.parent / name), (inside, inside / name)):
        shutil.copytree(raw / "0000", scans / "0000")
        shutil.copytree(raw.parent / "THuman2.0_smplx" / "0000", fits / "0000")
        assert find_fits(scans, None) == fits
        source = THuman2Source(scans, find_fits(scans, None))
        assert source.names() == ["0000"]
        assert len(source.load("0000").body_vertices) == 13380


def test_scans_without_fits_have_no_body(raw, tmp_path):
    """Scans alone can be rendered, without bodies."""
    shutil.copytree(raw / "0000", tmp_path / "0000")
    source = THuman2Source(tmp_path, find_fits(tmp_path, None))
    assert source.load("0000").body_vertices is None
    assert source.facing("0000") == 0


def test_a_split_need_not_be_that_of_the_folders(rendered, tmp_path):
    """data.split selects across the folders train and val."""
    assert module(rendered).subjects("val") == {"0426": tuple(range(16))}
    swapped = module(rendered, split={"train": ["0426"], "val": ["0000-0400"]})
    assert list(swapped.subjects("train")) == ["0426"]
    assert list(swapped.subjects("val")) == ["0000"]
    assert swapped.training_batch(0).subjects == ("0426",)
    (tmp_path / "split_train.txt").write_text("0426\n")
    (tmp_path / "split_val.txt").write_text("0000\n")
    assert list(module(rendered, split=str(tmp_path)).subjects("val")) == ["0000"]


def composed(name, root, *overrides):
    cfg = compose("train", [f"experiment={name}", f"data.root={root}", "data.workers=0", *overrides])
    return build(cfg.data, "data", views=cfg.views, targets=cfg.targets, seed=cfg.seed), cfg


@pytest.mark.parametrize(
    ("experiment", "size", "inputs", "targets"),
    [
        ("thuman2", 512, ["000/0", "004/0", "008/0", "012/0"], ["000/3"]),
        ("thuman2_ghg", 1024, ["000/0", "006/0", "011/0"], ["003/0", "008/0", "013/0"]),
        ("thuman2_rogsplat", 512, ["000/0", "004/0", "008/0", "012/0"], [f"{p:03d}/3" for p in range(16)]),
    ],
)
def test_named_protocols(rendered, experiment, size, inputs, targets):
    """Each experiment= has the size, inputs and targets of its publication."""
    data, cfg = composed(experiment, rendered)
    assert data.dataset.size == (size, size)
    assert list(cfg.evaluation.targets) == [data.targets.name]
    batch = next(iter(data.evaluation_loader(targets=data.targets)))
    assert list(batch.views[0]) == inputs
    assert list(batch.targets.names[0]) == targets
    assert batch.images.shape[-2:] == (size, size)
    training = data.training_batch(0)
    assert {name[-1] for name in training.targets.names[0]} <= {"2", "3", "4"}
    assert len(training.targets.names[0]) == (3 if experiment == "thuman2_ghg" else 1)
