"""``ghgs predict images=...`` and ``ghgs doctor`` from files to files, and the example."""

import json
import runpy
import shutil
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from imageio_ffmpeg import read_frames
from plyfile import PlyData
from scipy.ndimage import binary_dilation

from ghgs_capture.rig import Rig
from ghgs_capture.verbs.advice import moved_line
from ghgs_lit.weights.checkpoint import write_checkpoint
from tests.helpers.figures import PARTS, Figure
from tests.helpers.models import config, make_model
from tests.helpers.verbs import ghgs

EXAMPLES = Path(__file__).parents[3] / "examples"


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.ckpt"
    trained = {**config("model=hull"), "data": {"size": 56}}
    write_checkpoint(path, make_model("model=hull").state_dict(), trained)
    return path


@pytest.fixture
def here(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def inside_the_figure(path: Path, scale: float = 1.0) -> float:
    """The share of a splat's Gaussians that lie near the figure, in its world."""
    vertices = PlyData.read(str(path))["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], -1) / scale
    boxes = [(np.abs(points - center) <= np.array(radii) + 0.25).all(-1) for center, radii in PARTS]
    return float(np.any(boxes, 0).mean())


def test_photographs_become_a_splat_where_the_subject_is(here, checkpoint, capsys, monkeypatch):
    """In the user's world and unit, with what was done in the report; a read-only working directory
    is no obstacle, as nothing is written there."""
    cameras = Figure(scale=1000.0).write(here / "images")
    closed = here / "closed"
    closed.mkdir(mode=0o555)
    monkeypatch.chdir(closed)
    common = (f"checkpoint={checkpoint}", "formats=[ply,depth]", "turntable.frames=0", "device=cpu")
    places = (f"images={here / 'images'}", f"cameras={cameras}", f"out={here / 'splat'}")
    extended = json.loads(cameras.read_text()) | {"note": "by hand"}
    cameras.write_text(json.dumps(extended))
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        assert ghgs("predict", *places, *common) == 0
    assert [str(w.message) for w in shown if "note" in str(w.message)] == [
        "cameras: entries that are not read: note"
    ]
    assert not list(closed.iterdir())
    out = capsys.readouterr().out
    assert f"{here / 'splat' / 'depth.npz'}" in out
    assert "gaussians.ply" in out
    assert "calibration.unit=0.001" in out
    assert inside_the_figure(here / "splat" / "gaussians.ply", 1000.0) > 0.95
    report = json.loads((here / "splat" / "report.json").read_text())
    assert report["views"] == ["cam0", "cam1", "cam2", "cam3"]
    assert report["subject_size"] == pytest.approx(1730, rel=0.06)
    assert {"read", "crop", "predict"} <= set(report["seconds"])


def test_cameras_are_corrected_where_asked(here, checkpoint, capsys):
    """The report says by how many pixels; the splat is where the corrected cameras see
    the subject."""
    cameras = Figure(scale=1000.0).write(here / "images")
    run = (
        f"checkpoint={checkpoint}",
        "formats=[ply]",
        "turntable.frames=0",
        "device=cpu",
        "refine_cameras=1",
    )
    assert ghgs("predict", "images=images", f"cameras={cameras}", "out=splat", *run) == 0
    report = json.loads((here / "splat" / "report.json").read_text())
    assert list(report["refine_cameras"]) == report["views"]
    moved = list(report["refine_cameras"].values())
    assert 0 < max(moved) < 3
    assert f"refine_cameras: moved by {moved[0]:.2f}, {moved[1]:.2f}," in capsys.readouterr().out
    assert report["seconds"]["refine_cameras"] > 0
    assert inside_the_figure(here / "splat" / "gaussians.ply", 1000.0) > 0.95


def test_a_camera_that_moved_alone_is_named():
    """One of four was bumped: which one, and by how much."""
    line = moved_line({"front": 0.0, "left": 5.234, "back": 0.0, "right": 0.0})
    assert line == "refine_cameras: moved by 0.00, 5.23, 0.00, 0.00 pixels: left beside the others"
    assert moved_line({"front": 1.0, "left": 2.0}) == "refine_cameras: moved by 1.00, 2.00 pixels"
    assert moved_line({"front": 0.0, "left": 0.0}) == "refine_cameras: moved by 0.00, 0.00 pixels"


def test_masks_are_refined_where_asked(here, checkpoint, capsys):
    """The report says by how much; photographs of data sets have nothing beside the subject."""
    figure = Figure()
    figure.masks = np.stack([binary_dilation(mask, iterations=2) for mask in figure.masks])
    cameras = figure.write(here / "images")
    run = (f"checkpoint={checkpoint}", "formats=[ply]", "turntable.frames=0", "device=cpu", "refine_masks=3")
    assert ghgs("predict", "images=images", f"cameras={cameras}", "out=splat", *run) == 0
    report = json.loads((here / "splat" / "report.json").read_text())
    assert len(report["refine_masks"]) == 4
    assert 0.1 < min(report["refine_masks"]) < max(report["refine_masks"]) < 0.6
    printed = capsys.readouterr()
    assert f"refine_masks: changed by {report['refine_masks'][0]:.1%}, " in printed.out
    assert report["seconds"]["refine_masks"] > 0
    assert ghgs("predict", "data=synthetic", *run) == 1
    assert "refine_masks: expected 0 without images=..." in capsys.readouterr().err


def test_what_makes_a_prediction_poor_is_said(here, checkpoint, capsys):
    """Crops that training never showed, too few photographs, and inputs that do not come back."""
    figure = Figure()
    cameras = figure.write(here / "images")
    for name in figure.names[1::2]:
        next((here / "images").glob(f"{name}.*")).unlink()
    run = (f"checkpoint={checkpoint}", "formats=[ply]", "turntable.frames=0", "device=cpu", "refine_masks=1")
    larger = "size: 70 x 70 is larger than the 56 x 56 of the training, .* up to that fit, such as 56, 14"
    with pytest.warns(UserWarning, match=larger):
        assert ghgs("predict", "images=images", f"cameras={cameras}", "out=splat", "size=70", *run) == 0
    out = capsys.readouterr().out
    assert "2 photographs leave much unseen: 3 to 5 all around show a person" in out
    report = json.loads((here / "splat" / "report.json").read_text())
    low, high = sorted(report["psnr_box_of_inputs"].values())
    said = (
        f"photographs come back at {low:.1f} to {high:.1f} dB only, sound ones at 30 or more: mostly cameras"
    )
    assert f"{said} or masks are off (refine_cameras=4 may mend them); sheet.png shows where\n" in out
    assert ghgs("predict", "images=images", f"cameras={cameras}", "out=other", "size=50", *run) == 1
    assert "size: expected sides divisible by the patch size 14; found" in capsys.readouterr().err


def test_a_folder_for_each_instant_becomes_a_folder_of_splats(here, checkpoint, capsys):
    cameras = Figure().write(here / "images" / "000")
    shutil.copytree(here / "images" / "000", here / "images" / "001")
    common = (f"checkpoint={checkpoint}", "formats=[ply,mp4]", "turntable.frames=1", "device=cpu")
    assert ghgs("predict", "images=images", f"cameras={cameras}", "out=splats", *common) == 0
    out = capsys.readouterr().out
    assert "2 instants" in out
    assert f"{here / 'splats' / '001'}\n" in out  # a line for each instant, not for each of its files
    assert "001/gaussians.ply" not in out
    assert f"{here / 'splats' / 'sequence'}/ (2 files)" in out
    _, first, second = read_frames(str(here / "splats" / "instants.mp4"))
    first, second = (np.frombuffer(frame, np.uint8) for frame in (first, second))
    assert first.max() > 60  # the person is in the picture
    assert np.abs(first.astype(int) - second).max() < 8
    one, two = ((here / "splats" / name / "gaussians.ply").read_bytes() for name in ("000", "001"))
    assert one == two


def test_cameras_of_a_sequence_are_corrected_once_and_the_next_one_reads_them(
    here, checkpoint, capsys, monkeypatch
):
    """What the correction finds (here a shift of each camera) is in the crops of all instants."""
    for instant in ("000", "001", "002"):
        cameras = Figure().write(here / "images" / instant)
    asked = []

    def correct(captures, model, size, rounds, masks, renderer):
        asked.append(([capture.name for capture in captures], rounds))
        poses = {photograph.name: photograph.extrinsics.copy() for photograph in captures[0].photographs}
        for pose in poses.values():
            pose[0, 3] += 0.05
        return Rig(poses, dict.fromkeys(poses, 1.02), dict.fromkeys(poses, 1.5))

    monkeypatch.setattr("ghgs_capture.verbs.predict.corrected_rig", correct)
    common = (f"checkpoint={checkpoint}", "formats=[inputs]", "turntable.frames=0", "device=cpu")
    common = (*common, "images=images", "refine_masks=0", "check_cameras=false")
    assert ghgs("predict", f"cameras={cameras}", "out=splats", "refine_cameras=3", *common) == 0
    assert asked == [(["000", "001", "002"], 3)]
    out = capsys.readouterr().out
    assert "refine_cameras: moved by 1.50, 1.50, 1.50, 1.50 pixels in all instants; " in out
    assert "rig.json" in json.loads((here / "splats" / "report.json").read_text())["files"]
    assert ghgs("predict", "cameras=splats/rig.json", "out=again", "refine_cameras=0", *common) == 0
    given = json.loads(cameras.read_text())["cameras"]
    for instant in ("000", "002"):
        one, two = (
            json.loads((here / out / instant / "cameras.json").read_text()) for out in ("splats", "again")
        )
        for name, camera in one["cameras"].items():
            for key in ("intrinsics", "extrinsics"):
                np.testing.assert_allclose(camera[key], two["cameras"][name][key], atol=1e-5)
            assert camera["extrinsics"][0][3] == pytest.approx(given[name]["extrinsics"][0][3] + 0.05)
    assert ghgs("predict", f"cameras={cameras}", "out=none", "refine_cameras=0", *common) == 0
    assert not (here / "none" / "rig.json").exists()


def test_gains_of_a_rig_are_written_read_and_said(here, checkpoint, capsys, monkeypatch):
    """The next capture, of one instant, has the same photographs; without gains nothing is said."""
    for instant in ("000", "001"):
        cameras = Figure().write(here / "images" / instant)
    gains = {"cam0": [0.8] * 3, "cam1": [1.25] * 3, "cam2": [1.0, 0.8, 1.25], "cam3": [1.0, 1.25, 0.8]}

    def correct(captures, *others):
        named = {photograph.name: photograph for photograph in captures[0].photographs}
        poses, ones = {name: p.extrinsics for name, p in named.items()}, dict.fromkeys(named, 1.0)
        return Rig(poses, ones, ones, gains={name: np.array(values) for name, values in gains.items()})

    monkeypatch.setattr("ghgs_capture.verbs.predict.corrected_rig", correct)
    common = (f"checkpoint={checkpoint}", "formats=[inputs]", "turntable.frames=0", "device=cpu")
    common = (*common, "refine_masks=0", "check_cameras=false")
    said = "gains: cam0 20% darker, cam1 25% brighter than the mean of the cameras, undone\n"
    assert ghgs("predict", "images=images", f"cameras={cameras}", "out=splats", *common) == 0
    assert capsys.readouterr().out.count(said) == 1
    one = (*common, "images=images/001", "refine_cameras=0")
    assert ghgs("predict", "cameras=splats/rig.json", "out=next", *one) == 0
    assert said in capsys.readouterr().out
    assert ghgs("predict", f"cameras={cameras}", "out=alone", *one) == 0
    assert "gains: " not in capsys.readouterr().out
    folders = [here / "splats" / "001", here / "next", here / "alone"]
    first, second, alone = (json.loads((folder / "report.json").read_text()) for folder in folders)
    assert first["gains"] == second["gains"]
    for name, values in gains.items():
        assert first["gains"][name] == pytest.approx(values, rel=1e-5)
    assert "gains" not in alone
    first, second, alone = (next(folder.rglob("cam0*.png")).read_bytes() for folder in folders)
    assert first == second != alone


def test_a_sequence_goes_on_where_an_instant_lacks_photographs(here, checkpoint, capsys):
    """Three of four predict; two do not, which is said and counted.
    Of nothing else there is an error."""
    for instant in ("000", "001", "002"):
        cameras = Figure().write(here / "images" / instant)
    for path in (here / "images" / "000" / "cam0.png", here / "images" / "001" / "cam1.png"):
        path.write_bytes(b"broken")
    (here / "images" / "001" / "cam3.png").unlink()
    common = (
        f"checkpoint={checkpoint}",
        "formats=[ply]",
        "turntable.frames=0",
        "device=cpu",
        "images=images",
    )
    assert ghgs("predict", f"cameras={cameras}", "out=splats", *common) == 0
    out = capsys.readouterr().out
    assert "instant 000 is without cam0: " in out
    assert "instant 001 is left out: " in out
    assert "2 instants, " in out
    assert "left out: 1 of 3 instants\n" in out
    reports = {p.parent.name: json.loads(p.read_text()) for p in (here / "splats").glob("*/report.json")}
    assert {name: len(report["views"]) for name, report in reports.items()} == {"000": 3, "002": 4}
    (here / "images" / "000" / "cam1.png").unlink()
    assert ghgs("predict", f"cameras={cameras}", "out=none", "sequence.stop=2", *common) == 1
    assert "images: expected an instant that can be read; found 'none of 2'" in capsys.readouterr().err
    (here / "images" / "001" / "cam0.png").unlink()
    for name in ("cam1", "cam2"):
        (here / "images" / "000" / f"{name}.png").unlink(missing_ok=True)
    (here / "images" / "000" / "cam0.png").unlink()
    assert ghgs("predict", f"cameras={cameras}", "out=none", "sequence.stop=1", *common) == 1
    assert "expected 2 photographs or more; found 1" in capsys.readouterr().err


def test_wrong_cameras_are_refused_and_the_doctor_mends_them(here, checkpoint, capsys):
    figure = Figure()
    lens = {"distortion": [0.02, 0.001, 0.001, 0.001]}
    inverse = {
        name: {**c, **lens, "extrinsics": np.linalg.inv(c["extrinsics"]).tolist()}
        for name, c in figure.cameras.items()
    }
    common = ("images=images", f"cameras={figure.write(here / 'images', cameras=inverse)}")
    doctor = ("doctor", "task=cameras", *common, "hydra.run.dir=found")
    option = "calibration.extrinsics=camera_to_world"
    for command in (("predict", *common, f"checkpoint={checkpoint}", "out=splat"), doctor):
        assert ghgs(*command) == 1
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert option in error
    assert ghgs(*doctor, option) == 0
    assert "cameras and masks agree" in capsys.readouterr().out


def test_photographs_without_cameras_are_refused(here, checkpoint, capsys):
    assert ghgs("predict", "images=images", f"checkpoint={checkpoint}") == 1
    assert "cameras: expected cameras=<calibration>; found None" in capsys.readouterr().err


def test_the_example_runs(here, checkpoint, monkeypatch, capsys):
    cameras = Figure().write(here / "images")
    arguments = [here / "images", cameras, checkpoint, here / "splat.ply"]
    monkeypatch.setattr(sys, "argv", ["photographs_to_splat.py", *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / "photographs_to_splat.py"), run_name="__main__")
    assert "splat.ply: " in capsys.readouterr().out
    assert inside_the_figure(here / "splat.ply") > 0.95


def test_inputs_are_never_replaced(here, checkpoint, capsys):
    """Neither a calibration of the name of an output nor photographs,
    though an earlier run wrote them."""
    cameras = Figure().write(here / "cap")
    before = cameras.read_bytes()
    common = (f"checkpoint={checkpoint}", "turntable.frames=0", "device=cpu")
    assert ghgs("predict", "images=cap", f"cameras={cameras}", "out=cap", *common) == 1
    assert "cameras.json: expected another folder (out=...)" in capsys.readouterr().err
    assert cameras.read_bytes() == before
    run = ("images=cap", f"cameras={cameras}", "out=first", *common, "formats=[inputs]")
    assert ghgs("predict", *run) == 0
    assert ghgs("predict", *run) == 0
    again = ("images=first/inputs", "cameras=first/cameras.json", "out=first", *common, "formats=[inputs]")
    assert ghgs("predict", *again) == 1
    assert "found 'the input'" in capsys.readouterr().err
    (here / "other").mkdir()
    (here / "other" / "config.yaml").write_text("of: another program")
    assert ghgs("predict", "images=cap", f"cameras={cameras}", "out=other", *common) == 1
    assert "config.yaml: expected no file, or the configuration of an earlier run" in capsys.readouterr().err
