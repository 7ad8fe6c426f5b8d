"""Frozen weights are stored once next to the checkpoints of a run, and found wherever its folder is."""

import os
import shutil

import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.execution import Predictor
from ghgs_lit.training.checkpoints import AtomicCheckpointIO
from ghgs_lit.training.start import check_resume, initialize
from ghgs_lit.weights import frozen
from ghgs_lit.weights.checkpoint import FORMAT_VERSION, read_checkpoint, write_inference
from tests.helpers.models import config, load_model, make_model
from tests.helpers.training import held

FROZEN = "encoder.trainable=none"
TRAINING = {"global_step": 5, "optimizer_states": [], "lr_schedulers": [], "loops": {}, "callbacks": {}}
READERS = {
    "predict and evaluate": Predictor.from_checkpoint,
    "init_from": lambda path: initialize(make_model(FROZEN), path),
    "resume": lambda path: check_resume(path, held(make_model(FROZEN)), config(FROZEN)),
    "inference": lambda path: write_inference(path, path.with_name("half.ckpt"), "float16"),
}


@pytest.fixture(autouse=True)
def _every_size(monkeypatch):
    monkeypatch.setattr(frozen, "OWN", 0)


def content(model):
    return {
        "state_dict": {f"model.{key}": value for key, value in model.state_dict().items()},
        "frozen": [f"model.{key}" for key, value in model.named_parameters() if not value.requires_grad],
        "config": config(FROZEN),
        "format_version": FORMAT_VERSION,
        **TRAINING,
    }


@pytest.fixture
def run(tmp_path):
    """A folder with two checkpoints of one model, and the model."""
    model, files, folder = make_model(FROZEN), AtomicCheckpointIO(), tmp_path / "run" / "checkpoints"
    files.save_checkpoint(content(model), folder / "best.ckpt")
    with torch.no_grad():
        model.depth_head.dpt.scratch.output_conv2[-1].weight.add_(1)
    files.save_checkpoint(content(model), folder / "last.ckpt")
    return folder, model


def frozen_file(folder):
    (path,) = folder.glob(frozen.PATTERN)
    return path


def test_both_checkpoints_share_one_file(run):
    """The encoder's bytes are on the disk once; trained weights are in each checkpoint."""
    folder, model = run
    assert len(list(folder.iterdir())) == 3
    encoder = sum(value.nbytes for value in model.encoder.parameters())
    assert frozen_file(folder).stat().st_size > encoder > 0
    for name in ("best", "last"):
        stored = torch.load(folder / f"{name}.ckpt", weights_only=True)
        assert not {key for key in stored["state_dict"] if key in stored["frozen"]}
        assert any(key.startswith("model.depth_head") for key in stored["state_dict"])


@pytest.mark.parametrize("reader", READERS)
def test_every_reader_puts_them_together(run, tmp_path, reader):
    """Also after the folder was moved; exported files are complete."""
    folder, model = run
    moved = tmp_path / "elsewhere"
    shutil.move(folder, moved)
    READERS[reader](moved / "last.ckpt")
    again = load_model(moved / "last.ckpt").state_dict()
    assert all(torch.equal(value, again[key]) for key, value in model.state_dict().items())
    if reader == "inference":
        frozen_file(moved).unlink()
        half = load_model(moved / "half.ckpt").state_dict()
        assert all(torch.equal(value.half().float(), half[key]) for key, value in model.state_dict().items())


def missing(path):
    path.unlink()


def other(path):
    """Tensors with the right names and one different value."""
    tensors = torch.load(path, weights_only=True)
    next(iter(tensors.values())).view(-1)[0] += 1e-3
    torch.save(tensors, path)


def rotten(path):
    data = bytearray(path.read_bytes())
    near = max(torch.load(path, weights_only=True).values(), key=torch.Tensor.numel).numpy().tobytes()[:64]
    data[data.index(near) + 1] ^= 0x08
    path.write_bytes(data)


def no_tensors(path):
    torch.save([3], path)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    ("damage", "found"), [(missing, "none"), (other, "others"), (rotten, "others"), (no_tensors, "others")]
)
def test_other_frozen_weights_are_one_error(run, reader, damage, found):
    folder, _ = run
    name = frozen_file(folder).name
    damage(frozen_file(folder))
    with pytest.raises(InputError, match=rf"last\.ckpt: frozen_file: expected .*{name}.*; found {found}"):
        READERS[reader](folder / "last.ckpt")


@pytest.mark.parametrize("reference", [3, {"name": "../a.pt", "sha256": "0"}, {"name": "a.pt"}])
def test_a_reference_leads_nowhere_else(run, reference):
    folder, _ = run
    stored = torch.load(folder / "last.ckpt", weights_only=True)
    torch.save({**stored, "frozen_file": reference}, folder / "last.ckpt")
    with pytest.raises(InputError, match=r"last\.ckpt: frozen_file: expected"):
        read_checkpoint(folder / "last.ckpt")


@pytest.mark.parametrize("links", [True, False])
def test_runs_of_a_sweep_share_one_copy(tmp_path, monkeypatch, links):
    """If the file system has hard links, each run has a link of its own, and any run may be deleted."""
    model, paths = make_model(FROZEN), [tmp_path / run / "checkpoints" / "last.ckpt" for run in "ab"]
    if not links:
        monkeypatch.setattr(os, "link", lambda *_: os.stat(tmp_path / "none"))
    for path in paths:
        AtomicCheckpointIO().save_checkpoint(content(model), path)
    first, second = (frozen_file(path.parent).stat() for path in paths)
    assert (first.st_ino == second.st_ino) == links
    shutil.rmtree(paths[0].parent)
    load_model(paths[1])


def test_weights_that_changed_are_another_file(run):
    """A checkpoint never refers to values of another step."""
    folder, model = run
    files = AtomicCheckpointIO()
    files.save_checkpoint(content(model), folder / "last.ckpt")
    with torch.no_grad():
        next(model.encoder.parameters()).add_(1)
    files.save_checkpoint(content(model), folder / "last.ckpt")
    assert len(list(folder.glob(frozen.PATTERN))) == 2
    again = load_model(folder / "last.ckpt").state_dict()
    assert all(torch.equal(value, again[key]) for key, value in model.state_dict().items())


def test_small_ones_stay_in_the_checkpoint(tmp_path, monkeypatch):
    """A checkpoint of a small model can be copied alone."""
    monkeypatch.undo()
    AtomicCheckpointIO().save_checkpoint(content(make_model(FROZEN)), tmp_path / "last.ckpt")
    assert [path.name for path in tmp_path.iterdir()] == ["last.ckpt"]
    load_model(tmp_path / "last.ckpt")
