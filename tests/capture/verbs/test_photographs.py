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


@pytest.fixture
def predict(checkpoint):
    """Exit code of a prediction by the small model."""

    def run(cameras, *options):
        common = (f"checkpoint={checkpoint}", "turntable.frames=0", "device=cpu", "formats=[ply]")
        keys = {option.partition("=")[0] for option in options}
        common = (option for option in common if option.partition("=")[0] not in keys)
        return ghgs("predict", f"cameras={cameras}", *common, *options)

    return run


def report(folder: Path):
    return json.loads((folder / "report.json").read_text())


def inside_the_figure(path: Path, scale: float = 1.0) -> float:
    """Fraction of a splat's Gaussians near the figure, in its world."""
    vertices = PlyData.read(str(path))["vertex"]
    points = np.stack([vertices[axis] for axis in "xyz"], -1) / scale
    boxes = [(np.abs(points - center) <= np.array(radii) + 0.25).all(-1) for center, radii in PARTS]
    return float(np.any(boxes, 0).mean())


def test_photographs_become_a_splat_where_the_subject_is(here, predict, capsys, monkeypatch):
    """In the user's world and unit, with corrections in the report; works in a read-only working directory,
    since nothing is written there."""
    cameras = Figure(scale=1000.0).write(here / "images")
    closed = here / "closed"
    closed.mkdir(mode=0o555)
    monkeypatch.chdir(closed)
    cameras.write_text(json.dumps(json.loads(cameras.read_text()) | {"note": "by hand"}))
    with warnings.catch_warnings(record=True) as shown:
        warnings.simplefilter("always")
        options = f"images={here / 'images'}", f"out={here / 'splat'}", "formats=[ply,html]"
        assert predict(cameras, *options) == 0
    messages = [str(w.message) for w in shown if "note" in str(w.message)]
    assert messages == ["cameras: entries that are not read: note"]
    assert not list(closed.iterdir())
    out = capsys.readouterr().out
    assert "units tall" in out
    assert out.splitlines()[-1] == f"wrote {here / 'splat'}"
    assert (here / "splat" / "viewer.html").exists()
    assert inside_the_figure(here / "splat" / "gaussians.ply", 1000.0) > 0.95
    assert report(here / "splat")["views"] == ["cam0", "cam1", "cam2", "cam3"]
    assert report(here / "splat")["subject_size"] == pytest.approx(1730, rel=0.06)


def test_cameras_and_masks_are_corrected_where_asked(here, predict, capsys):
    """The report contains the amounts; the splat is where the corrected cameras see the subject.
    Photographs of data sets show nothing except the subject."""
    figure = Figure(scale=1000.0)
    assert predict(figure.write(here / "images"), "images=images", "out=splat", "refine_cameras=1") == 0
    moved = report(here / "splat")["refine_cameras"]
    assert list(moved) == figure.names
    assert 0 < max(moved.values()) < 3
    out = capsys.readouterr().out
    assert f"refine_cameras: moved by cam0 {moved['cam0']:.2f}, cam1 {moved['cam1']:.2f}," in out
    assert inside_the_figure(here / "splat" / "gaussians.ply", 1000.0) > 0.95
    figure.masks = np.stack([binary_dilation(mask, iterations=2) for mask in figure.masks])
    assert predict(figure.write(here / "images"), "images=images", "out=splat", "refine_masks=3") == 0
    changed = report(here / "splat")["refine_masks"]
    assert len(changed) == 4
    assert 0.1 < min(changed) < max(changed) < 0.6
    assert f"refine_masks: changed by {changed[0]:.1%}, " in capsys.readouterr().out
    assert ghgs("predict", "data=synthetic", "refine_masks=3") == 1
    assert "refine_masks: expected 0 without images=..." in capsys.readouterr().err


def test_what_makes_a_prediction_poor_is_said(here, predict, capsys):
    """Crops unlike those of the training, and input views that are rendered poorly."""
    cameras = Figure().write(here / "images")
    larger = "size: 70 x 70 is larger than the 56 x 56 of the training"
    with pytest.warns(UserWarning, match=larger):
        assert predict(cameras, "images=images", "out=splat", "size=70", "refine_masks=1") == 0
    low, *_, high = sorted(report(here / "splat")["psnr_box_of_inputs"].values())
    assert f"photographs come back at {low:.1f} to {high:.1f} dB only, " in capsys.readouterr().out
    assert predict(cameras, "images=images", "out=other", "size=50") == 1
    assert "size: expected sides divisible by the patch size 14; found" in capsys.readouterr().err


def test_a_folder_for_each_instant_becomes_a_folder_of_splats(here, predict, capsys):
    cameras = Figure().write(here / "images" / "000")
    shutil.copytree(here / "images" / "000", here / "images" / "001")
    assert predict(cameras, "images=images", "out=splats", "formats=[ply,mp4]", "turntable.frames=1") == 0
    out = capsys.readouterr().out
    assert "2 instants" in out
    assert f"{here / 'splats' / '001'}\n" in out
    _, first, second = read_frames(str(here / "splats" / "instants.mp4"))
    first, second = (np.frombuffer(frame, np.uint8) for frame in (first, second))
    assert first.max() > 60  # the person is in the picture
    assert np.abs(first.astype(int) - second).max() < 8
    one, two = ((here / "splats" / name / "gaussians.ply").read_bytes() for name in ("000", "001"))
    assert one == two


GAINS = {"cam0": [0.8] * 3, "cam1": [1.25] * 3, "cam2": [1.0, 0.8, 1.25], "cam3": [1.0, 1.25, 0.8]}


def test_a_rig_is_corrected_once(here, predict, capsys, monkeypatch):
    """The correction (here a shift of each camera, and gains) applies to the crops of all instants."""
    for instant in ("000", "001", "002"):
        cameras = Figure().write(here / "images" / instant)
    asked = []

    def correct(captures, model, size, rounds, masks, renderer):
        asked.append(([capture.name for capture in captures], rounds))
        poses = {photograph.name: photograph.extrinsics.copy() for photograph in captures[0].photographs}
        for pose in poses.values():
            pose[0, 3] += 0.05
        gains = {name: np.array(values) for name, values in GAINS.items()}
        return Rig(poses, dict.fromkeys(poses, 1.02), dict.fromkeys(poses, 1.5), gains=gains)

    monkeypatch.setattr("ghgs_capture.verbs.predict.correct_rig", correct)
    common = "formats=[inputs]", "refine_masks=0", "check_cameras=false"
    assert predict(cameras, "images=images", "out=splats", "refine_cameras=3", *common) == 0
    assert asked == [(["000", "001", "002"], 3)]
    moved = ", ".join(f"{name} 1.50" for name in GAINS)
    assert f"refine_cameras: moved by {moved} pixels in all instants; " in capsys.readouterr().out
    one = *common, "images=images/002", "refine_cameras=0"
    given = json.loads(cameras.read_text())["cameras"]
    for name, camera in json.loads((here / "splats" / "002" / "cameras.json").read_text())["cameras"].items():
        assert camera["extrinsics"][0][3] == pytest.approx(given[name]["extrinsics"][0][3] + 0.05)
        assert report(here / "splats" / "002")["gains"][name] == pytest.approx(GAINS[name], rel=1e-5)
    assert predict(cameras, "out=alone", *one) == 0
    assert "gains" not in report(here / "alone")
    pictures = [(here / name / "inputs" / "cam0.png").read_bytes() for name in ("splats/002", "alone")]
    assert pictures[0] != pictures[1]


def test_a_sequence_goes_on_where_an_instant_lacks_photographs(here, predict, capsys):
    """Three of four photographs suffice; two do not, which is reported and counted. If no instant is left,
    it is an error."""
    for instant in ("000", "001", "002"):
        cameras = Figure().write(here / "images" / instant)
    for path in (here / "images" / "000" / "cam0.png", here / "images" / "001" / "cam1.png"):
        path.write_bytes(b"broken")
    (here / "images" / "001" / "cam3.png").unlink()
    assert predict(cameras, "out=splats", "images=images") == 0
    out = capsys.readouterr().out
    assert "instant 000 is without cam0: " in out
    assert "instant 001 is left out: " in out
    assert "2 instants, " in out
    assert "left out: 1 of 3 instants\n" in out
    views = {p.parent.name: len(report(p.parent)["views"]) for p in (here / "splats").glob("*/report.json")}
    assert views == {"000": 3, "002": 4}
    (here / "images" / "000" / "cam1.png").unlink()
    assert predict(cameras, "out=none", "sequence.stop=2", "images=images") == 1
    assert "images: expected an instant that can be read; found 'none of 2'" in capsys.readouterr().err
    for name in ("001/cam0", "000/cam2", "000/cam0"):
        (here / "images" / f"{name}.png").unlink()
    assert predict(cameras, "out=none", "sequence.stop=1", "images=images") == 1
    assert "expected 2 photographs or more; found 1" in capsys.readouterr().err


def test_wrong_cameras_are_refused_and_the_doctor_mends_them(here, predict, capsys):
    figure = Figure()
    lens = {"distortion": [0.02, 0.001, 0.001, 0.001]}
    inverse = {
        name: {**c, **lens, "extrinsics": np.linalg.inv(c["extrinsics"]).tolist()}
        for name, c in figure.cameras.items()
    }
    cameras = figure.write(here / "images", cameras=inverse)
    doctor = ("doctor", "task=cameras", "images=images", f"cameras={cameras}", "hydra.run.dir=found")
    option = "calibration.extrinsics=camera_to_world"
    for command in (lambda: predict(cameras, "images=images", "out=splat"), lambda: ghgs(*doctor)):
        assert command() == 1
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert option in error
    assert ghgs(*doctor, option) == 0
    assert "cameras and masks agree" in capsys.readouterr().out


def test_the_example_runs(here, checkpoint, monkeypatch, capsys):
    cameras = Figure().write(here / "images")
    arguments = [here / "images", cameras, checkpoint, here / "splat.ply"]
    monkeypatch.setattr(sys, "argv", ["photographs_to_splat.py", *map(str, arguments)])
    runpy.run_path(str(EXAMPLES / "photographs_to_splat.py"), run_name="__main__")
    assert "splat.ply: " in capsys.readouterr().out
    assert inside_the_figure(here / "splat.ply") > 0.95


def test_inputs_are_never_replaced(here, predict, checkpoint, capsys):
    """Neither a calibration with the name of an output nor photographs, even if an earlier run wrote them."""
    assert ghgs("predict", "images=images", f"checkpoint={checkpoint}") == 1
    assert "cameras: expected cameras=<calibration>; found None" in capsys.readouterr().err
    cameras = Figure().write(here / "cap")
    before = cameras.read_bytes()
    assert predict(cameras, "images=cap", "out=cap", "formats=[inputs]") == 1
    assert "cameras.json: expected another folder (out=...)" in capsys.readouterr().err
    assert cameras.read_bytes() == before
    for _ in range(2):
        assert predict(cameras, "images=cap", "out=first", "formats=[inputs]") == 0
    assert predict("first/cameras.json", "images=first/inputs", "out=first", "formats=[inputs]") == 1
    assert "found 'the input'" in capsys.readouterr().err
    (here / "other").mkdir()
    (here / "other" / "config.yaml").write_text("of: another program")
    assert predict(cameras, "images=cap", "out=other") == 1
    assert "config.yaml: expected no file, or the configuration of an earlier run" in capsys.readouterr().err
