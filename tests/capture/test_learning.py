"""Instants of a capture as a data set, in which each camera in turn is the target."""

import json
import shutil

import numpy as np
import pytest
import torch

from ghgs_capture.capture import Capture
from ghgs_capture.folder import CaptureFolder
from ghgs_capture.learning import LISTING, Instants, agrees, splits_of, write_instant
from ghgs_capture.verbs import adapt
from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.geometry.frame import HEIGHT, Frame
from tests.helpers.figures import Figure
from tests.helpers.models import load_model
from tests.helpers.verbs import ghgs

SIZE = 42
NAMES = ["a", "b", "c", "d"]


def sequence(place, instants=3, views=4, masks=True):
    """A folder for each instant, with a figure in different colours, and the cameras."""
    figure = Figure(views=views, height=96, width=96)
    for number in range(instants):
        images = figure.images.copy()
        figure.images = np.where(figure.masks[..., None], 255 - images // (number + 1), images)
        shutil.move(figure.write(place / "images" / f"i{number}", masks=masks), place / "cameras.json")
        figure.images = images
    return [f"images={place / 'images'}", f"cameras={place / 'cameras.json'}"]


@pytest.fixture
def written(tmp_path):
    """A data module of three instants, and the crops of each."""
    sequence(tmp_path)
    folder = CaptureFolder(tmp_path / "images", tmp_path / "cameras.json")
    root = tmp_path / "instants"
    root.mkdir()
    crops = {}
    for name in folder.instants:
        capture = Capture(name, folder.photographs(name))
        write_instant(capture, root, (SIZE, SIZE))
        batch = capture.batch((SIZE, SIZE))
        crops[name] = Frame.of(batch).enter(batch)
    (root / LISTING).write_text(json.dumps(splits_of(folder.instants)))
    cameras = tuple(crops[name].views[0])
    data = Instants(root=str(root), cameras=cameras, size=SIZE, batch_size=1, workers=0)
    views = {"training_counts": [3], "evaluation_count": 3}
    targets = {**run_of("adapt", ["targets=cameras"]).plain["targets"], "per_step": 1}
    return data.build(views, targets, seed=1), crops


def require_crop(batch, crops, name):
    """Check that inputs and target are the crops of an instant, each camera once; return the target."""
    seen = torch.cat((batch.images, batch.targets.images), 1)[0]
    lenses = torch.cat((batch.cameras.intrinsics, batch.targets.cameras.intrinsics), 1)[0]
    poses = torch.cat((batch.cameras.extrinsics, batch.targets.cameras.extrinsics), 1)[0]
    order = []
    for pose in poses:
        away = (crops[name].cameras.extrinsics[0] - pose).abs().flatten(1).amax(1)
        order.append(int(away.argmin()))
        assert away.min() < 1e-5
    assert sorted(order) == [0, 1, 2, 3]
    torch.testing.assert_close(lenses, crops[name].cameras.intrinsics[0, order].float())
    assert (seen - crops[name].images[0, order]).abs().max() <= 0.5 / 255 + 1e-6
    return order[-1]


def test_each_camera_is_measured_once(written):
    data, crops = written
    names = data.subjects("val")
    assert len(names) == 4
    targets = [require_crop(data.evaluation_batch(n, targets=data.targets), crops, n[:2]) for n in names]
    assert sorted(targets) == [0, 1, 2, 3]


def test_each_camera_is_learned_from(written):
    data, crops = written
    targets, names = set(), set()
    for step in range(24):
        batch = data.training_batch(step)
        names.add(batch.subjects[0])
        targets.add(require_crop(batch, crops, batch.subjects[0]))
        height = torch.linalg.inv(batch.cameras.extrinsics[0])[:, :3, 3].norm(dim=-1)
        assert (height > HEIGHT / 2).all()  # cameras stand around the subject, in its frame
    assert targets == {0, 1, 2, 3}
    assert names == set(data.subjects("train"))
    assert not {name.partition("/")[0] for name in data.subjects("val")} & names


def test_some_instants_are_only_measured():
    for count, measured in ((2, 1), (4, 1), (10, 2), (50, 3), (200, 3)):
        splits = splits_of([str(i) for i in range(count)])
        assert len(splits["val"]) == measured
        assert len(splits["train"]) == count - measured
        assert not set(splits["val"]) & set(splits["train"])
    with pytest.raises(InputError, match="images: expected two instants or more to learn from"):
        splits_of(["0"])


@pytest.mark.parametrize(
    ("instants", "views", "masks", "message"),
    [
        (1, 4, True, "images: expected folders of two instants or more; found 1"),
        (3, 2, True, "cameras: expected three to eight cameras, of which one is the target; found 2"),
        (2, 9, True, "cameras: expected three to eight cameras, of which one is the target; found 9"),
        (3, 4, False, "expected a mask of the subject: masks=<folder>"),
    ],
)
def test_what_cannot_be_learned_from_is_refused(tmp_path, capsys, instants, views, masks, message):
    said = sequence(tmp_path, instants, views, masks)
    assert ghgs("adapt", *said, f"hydra.run.dir={tmp_path / 'run'}") == 1
    printed = capsys.readouterr().err
    assert message in printed
    assert len(printed.splitlines()) == 1


def test_weights_learn_from_instants_and_an_interrupted_run_goes_on(tmp_path, monkeypatch, capsys):
    """Instants are prepared only once."""
    run, out = tmp_path / "run", tmp_path / "mine.ckpt"
    command = ["adapt", *sequence(tmp_path), f"out={out}", f"hydra.run.dir={run}", f"data.size={SIZE}"]
    command += ["trainer.max_steps=2", "evaluation.pictures=0"]
    monkeypatch.setattr(adapt, "train", lambda *_: None)
    ghgs(*command)
    assert "3 of 3 instants have masks that agree, and are learned from" in capsys.readouterr().out
    assert not out.exists()
    monkeypatch.undo()
    monkeypatch.setattr(adapt, "estimate_shared", None)
    assert ghgs(*command) == 0
    printed = capsys.readouterr().out
    assert "4 photographs of instants that were not learned from, each from the other cameras: " in printed
    assert printed.splitlines()[-1] == f"wrote {out}"
    shipped, mine = (load_model(path).state_dict() for path in ("shipped", out))
    assert any(not torch.allclose(shipped[name], mine[name], rtol=1e-2) for name in shipped)


def test_instants_whose_masks_fail_are_left_out(tmp_path):
    sequence(tmp_path, 1)
    folder = CaptureFolder(tmp_path / "images", tmp_path / "cameras.json")
    capture = Capture("i0", folder.photographs("i0"))
    assert agrees(capture)
    capture.photographs[1].matte[:, :48] = 0
    assert not agrees(capture)
