"""A miniature is written only where no other files are: real data of the same name is never changed."""

import functools

import pytest

from ghgs_lit.config import build, compose
from scripts import miniature as layouts
from scripts.miniatures import humman, scans, thuman2, zju_mocap
from tests.helpers.captures import refused

# For each data set: the key of the folder, a file of the real data in it,
# and the function that writes.
CASES = {
    "zju_mocap": ("root", "CoreView_386/annots.npy", zju_mocap, "make"),
    "humman": ("root", "p000455_a000986/cameras.json", humman, "make"),
    "thuman2": ("root", "train/img/0000_000/0.jpg", thuman2, "make"),
    "thuman2 raw": ("source", "0000/0000.obj", scans, "make_scans"),
}


@pytest.fixture(params=CASES)
def case(request, tmp_path, monkeypatch):
    """(make, folder, file of the real data): ``make`` writes that file instead of people."""
    key, file, module, function = CASES[request.param]
    folder = tmp_path / "data"

    def write(target, *arguments, **options):
        (target / file).parent.mkdir(parents=True, exist_ok=True)
        (target / file).write_text("miniature")
        return [target]

    monkeypatch.setattr(module, function, write)
    cfg = compose("prepare", [f"data={request.param.split()[0]}", f"data.{key}={folder}"])
    data = build(cfg.data, "data", views=cfg.views, targets=cfg.targets, seed=0)
    return (
        lambda: layouts.make_miniature(data.dataset, {"train": 1, "val": 1}, 64, 0),
        folder,
        folder / file,
    )


def test_real_data_is_not_overwritten(case):
    """A folder with files that no miniature wrote is rejected and unchanged."""
    make, folder, file = case
    file.parent.mkdir(parents=True)
    file.write_text("real")
    refused(
        rf"^{folder}: expected an empty folder.*; found files such as {sorted(folder.iterdir())[0].name}",
        make,
    )
    assert file.read_text() == "real"
    assert not (folder / scans.MARKER).exists()


def test_a_miniature_can_be_written_again(case):
    """Its own files are replaced, also after a killed run."""
    make, _, file = case
    make()
    file.write_text("older")
    make()
    assert file.read_text() == "miniature"


def test_what_lies_beside_is_not_overwritten(tmp_path):
    """The body model next to HuMMan and the fits next to raw scans are checked like the data itself."""
    for name, key, beside in (
        ("humman", "root", "data_body_models/smpl/SMPL_NEUTRAL.pkl"),
        ("thuman2", "source", "THuman2.0_smplx/0000/smplx_param.pkl"),
    ):
        path = tmp_path / name / beside
        path.parent.mkdir(parents=True)
        path.write_text("licensed")
        cfg = compose("prepare", [f"data={name}", f"data.{key}={tmp_path / name / 'data'}"])
        data = build(cfg.data, "data", views=cfg.views, targets=cfg.targets, seed=0)
        refused(
            "expected an empty folder",
            functools.partial(layouts.make_miniature, data.dataset, {"train": 1, "val": 0}, 64, 0),
        )
        assert path.read_text() == "licensed"
