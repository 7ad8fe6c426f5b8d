"""Problems that task=check finds without a body: masks, cameras, units, leakage."""

import shutil

import numpy as np
import pytest
from PIL import Image

from ghgs_lit.data.check import inspect
from ghgs_lit.errors import InputError
from tests.helpers.people import TINY, render_boxes, rendered

PLACE = "train/mask/s0_008/0.png"


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """Boxes with bodies."""
    folder = tmp_path_factory.mktemp("boxes")
    settings = TINY.replace(samples=1, positions=(0, 4, 8, 12), views=(0, 3))
    render_boxes(folder / "root", folder / "scans", train=2, val=1, settings=settings)
    return folder / "root"


@pytest.fixture
def root(sound, tmp_path):
    shutil.copytree(sound, tmp_path / "root")
    return tmp_path / "root"


def report(root, **changes):
    targets = {"name": "release", "training_views": [3]}
    return inspect(rendered(root, **{"targets": targets, "size": 42, **changes}))


def change(root, kind: str, function, names: str = "s0_*") -> None:
    """Apply ``function`` to the matrices of cameras."""
    for path in sorted(root.glob(f"train/parm/{names}/*_{kind}.npy")):
        np.save(path, function(np.load(path)))


def paint(root, function) -> None:
    """Apply ``function`` to the mask at :data:`PLACE`."""
    mask = np.asarray(Image.open(root / PLACE)) > 127
    Image.fromarray(function(mask).astype(np.uint8) * 255).save(root / PLACE)


def inverse(pose: np.ndarray) -> np.ndarray:
    return np.concatenate((pose[:, :3].T, -pose[:, :3].T @ pose[:, 3:]), 1)


def spot(mask: np.ndarray) -> np.ndarray:
    only = np.zeros_like(mask)
    only[20, 20] = True
    return only


DISAGREE = "expected a mask that the others of its subject allow"
DAMAGES = {
    "full mask": (lambda r: paint(r, lambda m: m | True), f"{PLACE}: .*not of the background; found 100%"),
    "inverted mask": (lambda r: paint(r, lambda m: ~m), f"{PLACE}: .*not of the background; found"),
    "one pixel": (lambda r: paint(r, spot), f"{PLACE}: expected a (subject of|mask that)"),
    "camera to world": (lambda r: change(r, "extrinsic", inverse), DISAGREE),
    "axes of OpenGL": (lambda r: change(r, "extrinsic", lambda e: np.diag([1, -1, -1]) @ e), DISAGREE),
    "one camera in millimetres": (
        lambda r: change(r, "extrinsic", lambda e: e * [1, 1, 1, 1000], "s0_008"),
        DISAGREE,
    ),
    "intrinsics of another size": (lambda r: change(r, "intrinsic", lambda k: k * [[2], [2], [1]]), DISAGREE),
}


@pytest.mark.parametrize("bodies", [True, False])
def test_sound_data_agrees(root, bodies):
    """Correct masks and cameras pass, and every body is counted."""
    if not bodies:
        for phase in ("train", "val"):
            shutil.rmtree(root / phase / "smpl")
    found = report(root)
    assert found.problems == []
    assert len(found.notes) == (0 if bodies else 2)
    assert [figures["bodies"] for figures in found.phases.values()] == ([2, 1] if bodies else [0, 0])
    least = ("least iou", 0.8) if bodies else ("least agreement", 0.97)
    assert all(figures[least[0]] > least[1] for figures in found.phases.values())


@pytest.mark.parametrize("kind", DAMAGES)
def test_damage_is_found_without_bodies(root, kind):
    """Each defect that silhouettes reveal is reported as one problem, without any body."""
    shutil.rmtree(root / "train/smpl")
    damage, line = DAMAGES[kind]
    damage(root)
    problems = report(root).problems
    assert len(problems) == 1, problems
    with pytest.raises(InputError, match=line):
        raise InputError(problems[0])


def test_other_units_are_named(root):
    """Consistent cameras in millimetres give only a note, as the subject could be a giant."""
    for phase in ("train", "val"):
        for path in sorted(root.glob(f"{phase}/parm/*/*_extrinsic.npy")):
            np.save(path, np.load(path) * [1, 1, 1, 1000])
        shutil.rmtree(root / phase / "smpl")
    found = report(root)
    assert found.problems == []
    for phase in ("train", "val"):
        (note,) = [line for line in found.notes if "metres" in line and line.startswith(phase)]
        assert note.endswith("units tall (millimetres?)")


def test_the_same_person_in_both_phases_is_a_problem(root):
    """A subject in both phases fails reading and the check."""
    for folder in sorted(root.glob("train/*/s1*")):
        shutil.copytree(folder, root / "val" / folder.parent.name / folder.name)
    (root / "rendering/done/val/s1").touch()
    (line,) = report(root).problems
    assert line == f"{root}: expected each subject in train or in val; found 's1' in both"
    data = rendered(root, targets={"name": "cameras", "view": 0}, size=42)
    with pytest.raises(InputError, match="found 's1' in both"):
        data.subjects("val")


def test_bodies_are_counted_where_photographs_are_missing(root):
    """A missing view is one problem, and the subject's body is still counted."""
    for path in sorted(root.glob("train/img/s0_*/3.jpg")):
        path.unlink()
    found = report(root)
    assert len(found.problems) == 4
    assert found.phases["train"]["bodies"] == 2
    assert not any("a body for each" in note for note in found.notes)
