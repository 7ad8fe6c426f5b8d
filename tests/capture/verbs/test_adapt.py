"""``ghgs adapt``: the cameras that it reads, and weights that predict."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from ghgs_capture.verbs import adapt
from ghgs_capture.verbs.adapt import _fill_of, with_rig
from ghgs_capture.verbs.advice import rig_advice
from ghgs_lit.cli.inputs import build_data
from ghgs_lit.config import compose, run_of
from ghgs_lit.data.view import half_centers
from ghgs_lit.errors import InputError
from ghgs_lit.method.model import GHGS
from ghgs_lit.parsing import read_yaml
from ghgs_lit.runs.results import read_results
from ghgs_lit.weights.checkpoint import read_checkpoint
from ghgs_people import jobs
from ghgs_people.rig import Rig
from scripts.miniatures import zju_mocap
from tests.helpers.captures import make_miniature
from tests.helpers.figures import Figure
from tests.helpers.people import box_person
from tests.helpers.verbs import ghgs

YAWS = (0.0, 90.0, 180.0, 270.0)


@pytest.fixture
def calibration(tmp_path):
    """A file of four cameras around a subject."""
    cameras = Rig().cameras(np.array(YAWS), 120, 100)
    pairs = zip(cameras.intrinsics.tolist(), cameras.extrinsics.tolist(), strict=True)
    entries = {
        f"c{i}": {"intrinsics": k, "extrinsics": e, "width": 100, "height": 120}
        for i, (k, e) in enumerate(pairs)
    }
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"cameras": entries}))
    return path


def test_all_cameras_of_a_file_are_the_rig(calibration):
    """Every one is an input; what the file does not say acts on it."""
    said = [f"cameras={calibration}", "calibration.pixel_centers=integer"]
    config = with_rig(run_of("adapt", said)).plain
    assert config["views"]["evaluation_count"] == 4
    assert config["views"]["training_counts"] == [4]
    assert config["evaluation"]["views"] == [4]
    stored = json.loads(calibration.read_text())["cameras"]["c2"]
    camera = config["data"]["cameras"]["c2"]
    assert camera["extrinsics"] == stored["extrinsics"]
    assert np.allclose(camera["intrinsics"], half_centers(np.asarray(stored["intrinsics"])))
    assert (camera["height"], camera["width"]) == (120, 100)


@pytest.mark.parametrize("numbers", ["data.active.train=5", "data.active={train: 5, val: 2}"])
def test_longer_trainings_see_more_people(calibration, monkeypatch, numbers):
    """Ten minutes over the people of three learn these by heart; numbers that were said stay."""
    run = run_of("adapt", [f"cameras={calibration}", "minutes=9", numbers])
    monkeypatch.setattr(adapt, "given_keys", lambda: [numbers.partition("=")[0]])
    data, few = (with_rig(run.replace(minutes=minutes)).plain["data"] for minutes in (9, 1))
    assert (data["people"], data["active"]) == ({"train": 96, "val": 6}, {"train": 5, "val": 2})
    assert few["people"] == run.plain["data"]["people"]


def test_cameras_that_do_not_say_their_size_are_refused(calibration):
    content = json.loads(calibration.read_text())
    for camera in content["cameras"].values():
        del camera["width"], camera["height"]
    calibration.write_text(json.dumps(content))
    with pytest.raises(InputError, match="the photographs' size, or images=<folder>"):
        with_rig(run_of("adapt", [f"cameras={calibration}"]))


def test_more_cameras_than_a_prediction_takes_are_refused(calibration):
    content = json.loads(calibration.read_text())
    content["cameras"] |= {f"d{i}": content["cameras"]["c0"] for i in range(5)}
    calibration.write_text(json.dumps(content))
    with pytest.raises(InputError, match="2 to 8 cameras, those of the photographs in images=; found 9"):
        with_rig(run_of("adapt", [f"cameras={calibration}"]))
    with pytest.raises(InputError, match="cameras=<calibration>; found None"):
        with_rig(run_of("adapt", []))


def test_weights_learn_and_are_written(calibration, tmp_path, monkeypatch, capsys):
    """The file predicts, holds other weights than those it began with,
    and both are measured alike."""
    monkeypatch.setattr(jobs.figures, "generate", lambda seed, index, active: box_person(f"p{index}"))
    monkeypatch.setenv("GHGS_CACHE", str(tmp_path / "cache"))
    small = ["data.size=42", "data.people={train: 2, val: 1}", "data.active.train=0", "data.active.val=0"]
    small += ["data.render_workers=0", "data.render.samples=1", "minutes=0.02", "evaluation.pictures=0"]
    run, out = tmp_path / "run", tmp_path / "mine.ckpt"
    assert ghgs("adapt", f"cameras={calibration}", f"out={out}", f"hydra.run.dir={run}", *small) == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[-1] == f"wrote {out}"
    assert read_yaml(run / "config.yaml")["optimizer"]["freeze_until"] == {}
    means = [read_results(path / "metrics.json") for path in (run / "before", run)]
    assert [len(result["rows"]) for result in means] == [4, 4]
    before, after = (result["summary"][0]["psnr"] for result in means)
    assert f"{before:.2f} dB before, {after:.2f} dB after" in printed
    assert ("no better: checkpoint=shipped stays" in printed) == (after <= before)
    shipped, mine = (GHGS.from_checkpoint(path).state_dict() for path in ("shipped", out))
    assert shipped.keys() == mine.keys()
    assert any(not torch.allclose(shipped[name], mine[name], rtol=1e-2) for name in shipped)
    cameras = Figure(views=3).write(tmp_path / "other")
    photographs = [f"images={cameras.parent}", f"cameras={cameras}", "formats=[ply]"]
    assert ghgs("predict", f"checkpoint={out}", *photographs, f"out={tmp_path / 'splat'}") == 0
    printed = capsys.readouterr().out
    assert "the weights were adapted to 4 photographs, not 3; checkpoint=shipped, or ghgs adapt" in printed
    assert "the weights were adapted to another rig: a camera is 30 degrees off; " in printed
    trained, own = read_checkpoint(out)["config"], Rig().cameras(np.array(YAWS[::-1]), 70, 70)
    batch = SimpleNamespace(views=[list("abcd")], cameras=own[None])
    assert list(rig_advice(trained, batch)) == []
    assert list(rig_advice(read_checkpoint("shipped")["config"], batch)) == []


def test_no_file_is_replaced(calibration, capsys):
    """The calibration, given as the place for the weights by mistake, stays as it is."""
    before = calibration.read_text()
    run = calibration.parent / "run"
    assert ghgs("adapt", f"cameras={calibration}", f"out={calibration}", f"hydra.run.dir={run}") == 1
    assert "out: expected a path where there is no file, or overwrite=true" in capsys.readouterr().err
    assert calibration.read_text() == before


def test_people_are_as_large_as_the_subject_of_the_photographs():
    """A tenth less to a tenth more than where it is tallest, least first."""
    mattes = np.zeros((2, 100, 80), np.uint8)
    mattes[0, 20:71], mattes[1, 30:61] = 255, 255
    assert _fill_of(mattes) == pytest.approx([0.45, 0.55])


def test_a_data_set_lends_its_cameras(tmp_path):
    """The inputs of its protocol, in the size of its photographs;
    people are as tall as its subject."""
    make_miniature(zju_mocap, tmp_path / "zju", ["386", "313"], 112, seed=3, frames=2)
    data = ["data=zju_mocap", f"data.root={tmp_path / 'zju'}", "data.size=112", "data.workers=0"]
    data += [
        f"data.split.{p}=[{{sequences: [{s}], frames: [0, 2, 1]}}]" for p, s in (("train", 386), ("val", 313))
    ]
    config = with_rig(run_of("adapt", data)).plain
    zju = build_data(run_of("adapt", data))
    batch = zju.evaluation_batch(next(iter(zju.subjects("val"))))
    assert config["data"]["kind"] == "people_in_rig"
    assert config["data"]["people"] == compose("adapt").data.people
    cameras = list(config["data"]["cameras"].values())
    assert len(cameras) == config["views"]["evaluation_count"] == 4
    for name in ("intrinsics", "extrinsics"):
        torch.testing.assert_close(torch.tensor([c[name] for c in cameras]), getattr(batch.cameras[0], name))
    assert {(c["height"], c["width"]) for c in cameras} == {(112, 112)}
    rows = batch.masks[0].any(2).sum(1)
    low, high = config["data"]["fill"]
    assert low < rows.max() / 112 < high
    with pytest.raises(InputError, match="cameras: expected null beside data=<data set>"):
        with_rig(run_of("adapt", [*data, "cameras=x.json"]))


def test_numbers_of_views_can_be_said(calibration, tmp_path, monkeypatch):
    """Weights for a rig of which a camera may fail are trained with fewer, too;
    measured are all cameras."""
    seen = []
    monkeypatch.setattr(adapt, "run_job", lambda run, *_: seen.append(run.views))
    for number, said in enumerate(([], ["views.training_counts=[3,4]"])):
        run = f"hydra.run.dir={tmp_path / str(number)}"
        assert ghgs("adapt", f"cameras={calibration}", run, *said) == 0
    assert [views.training_counts for views in seen] == [(4,), (3, 4)]
    assert [views.evaluation_count for views in seen] == [4, 4]
