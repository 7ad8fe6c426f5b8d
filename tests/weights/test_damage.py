"""Checkpoints that changed since they were written, and what none holds."""

import zipfile

import lightning.pytorch
import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.model import GHGS
from ghgs_lit.training.checkpoints import AtomicCheckpointIO
from ghgs_lit.training.start import check_resume, initialize
from ghgs_lit.weights.checkpoint import FORMAT_VERSION, read_checkpoint
from ghgs_lit.weights.exporting import export_weights, write_inference
from ghgs_lit.weights.reading import SHIPPED_FILE
from tests.helpers.models import config, make_model

TRAINING = {"global_step": 5, "optimizer_states": [], "lr_schedulers": [], "loops": {}, "callbacks": {}}


def content(**changes):
    state = {f"model.{key}": value for key, value in make_model().state_dict().items()}
    return {"state_dict": state, "config": config(), "format_version": FORMAT_VERSION, **TRAINING, **changes}


def flip(path, near):
    """Flip one bit of the bytes ``near``, which are in the file once."""
    data = bytearray(path.read_bytes())
    data[data.index(near) + 1] ^= 0x08
    path.write_bytes(data)


READERS = {
    "predict and evaluate": lambda path: GHGS.from_checkpoint(path),
    "init_from": lambda path: initialize(make_model(), path),
    "resume": lambda path: check_resume(path, make_model(), config()),
    "export": lambda path: export_weights(path, None, path.with_name("release.pth")),
    "inference": lambda path: write_inference(path, path.with_name("b.ckpt"), "float16"),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("save", [AtomicCheckpointIO().save_checkpoint, torch.save])
@pytest.mark.parametrize("where", ["weights", "configuration"])
def test_one_changed_bit_is_refused_by_every_reader(tmp_path, reader, save, where):
    """A flipped bit would be a slightly other model in silence."""
    path, made = tmp_path / "last.ckpt", content()
    name = "model.gaussian_head.dpt.projections.0.weight"
    name = name if name in made["state_dict"] else next(n for n in made["state_dict"] if "head" in n)
    save(made, path)
    read_checkpoint(path, whole=True)
    near = made["state_dict"][name].numpy().tobytes()[:64]
    flip(path, near if where == "weights" else b"neighborhood")
    with pytest.raises(InputError, match=r"last\.ckpt: expected .*written; found"):
        READERS[reader](path)


def test_the_shipped_file_has_checksums(tmp_path):
    path = tmp_path / "shipped.ckpt"
    with zipfile.ZipFile(SHIPPED_FILE) as archive:
        sizes = sorted(archive.infolist(), key=lambda record: record.file_size)
        records = [*sizes[-3:], *(record for record in sizes if record.filename.endswith("data.pkl"))]
        contents = [archive.read(record) for record in records]
    for data in contents:
        path.write_bytes(SHIPPED_FILE.read_bytes())
        flip(path, data[len(data) // 2 :][:256])
        with pytest.raises(InputError, match=r"shipped\.ckpt: expected"):
            GHGS.from_checkpoint(path)


TENSOR = torch.ones(2, 2)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *(
            ({"config": {**config(), node: value}}, rf"config\.{node}: expected a mapping")
            for node in ("data", "model", "skip", "encoder", "callbacks")
            for value in ([], "text", 3)
        ),
        ({"state_dict": {3: TENSOR}}, "state_dict: expected names of tensors; found 3"),
        ({"state_dict": {"model.a": TENSOR.to_sparse()}}, "model.a: expected a dense tensor"),
        ({"state_dict": {"model.a": TENSOR.to("meta")}}, "model.a: expected a dense tensor"),
        ({"state_dict": {"model.a": TENSOR.to(torch.float8_e4m3fn)}}, "model.a: expected .*float8"),
        ({"config": {3: {}}}, "config: expected keys of text; found 3"),
    ],
)
def test_what_no_checkpoint_holds_is_named(tmp_path, changes, message):
    torch.save(content(**changes), tmp_path / "a.ckpt")
    with pytest.raises(InputError, match=rf"a\.ckpt: {message}"):
        GHGS.from_checkpoint(tmp_path / "a.ckpt")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("global_step", "5"),
        ("optimizer_states", {}),
        ("optimizer_states", [3]),
        ("lr_schedulers", "text"),
        ("loops", "text"),
        ("callbacks", []),
        ("epoch", "text"),
        ("optimizer_states", [{"state": 3}]),
    ],
)
def test_a_state_of_training_of_another_form_is_refused(tmp_path, key, value):
    torch.save(content(**{key: value}), tmp_path / "a.ckpt")
    with pytest.raises(InputError, match=rf"a\.ckpt: {key}.*: expected .*; found"):
        check_resume(tmp_path / "a.ckpt", make_model(), config())


def test_a_missing_version_of_lightning_is_this_one(tmp_path):
    torch.save(content(), tmp_path / "a.ckpt")
    loaded = AtomicCheckpointIO().load_checkpoint(tmp_path / "a.ckpt")
    assert loaded["pytorch-lightning_version"] == lightning.pytorch.__version__
