"""Checkpoints for prediction alone."""

import re

import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.geometry import precision
from ghgs_lit.weights.checkpoint import (
    model_state,
    read_checkpoint,
    write_checkpoint,
    write_inference,
)
from tests.helpers.models import config, load_model, make_model
from tests.helpers.verbs import ghgs


@pytest.fixture
def trained(tmp_path):
    """A checkpoint with the entries that training adds."""
    path, state = tmp_path / "a.ckpt", make_model().state_dict()
    moments = [{name: tensor.clone() for name, tensor in state.items()} for _ in range(2)]
    write_checkpoint(path, state, config(), optimizer_states=moments, global_step=7)
    return path


@pytest.mark.parametrize("dtype", ["float16", "bfloat16", "float32"])
def test_weights_and_configuration_alone_are_written(trained, tmp_path, dtype):
    """Every tensor is the rounded original, optimizer and progress are gone, and the model is built
    without YAML."""
    write_inference(trained, tmp_path / "b.ckpt", dtype)
    before, after = read_checkpoint(trained), read_checkpoint(tmp_path / "b.ckpt")
    assert set(after) == {"state_dict", "config", "format_version"}
    assert after["config"] == {**before["config"], "resume": None, "init_from": None}
    assert after["state_dict"].keys() == before["state_dict"].keys()
    for name, tensor in before["state_dict"].items():
        assert torch.equal(after["state_dict"][name], tensor.to(getattr(torch, dtype)))
    share = (tmp_path / "b.ckpt").stat().st_size / trained.stat().st_size
    assert share < (0.4 if dtype == "float32" else 0.25)
    load_model(tmp_path / "b.ckpt")


def test_the_verb_prints_sizes_and_overwrites_on_demand(trained, tmp_path, capsys):
    arguments = [f"checkpoint={trained}", f"hydra.run.dir={tmp_path / 'r'}"]
    assert ghgs("export", *arguments, f"inference={tmp_path / 'b.ckpt'}", "dtype=float32") == 0
    text = capsys.readouterr().out
    assert re.search(r"^\d+\.\d MB to \d+\.\d MB$", text, re.MULTILINE)
    assert text.rstrip().endswith(f"wrote {tmp_path / 'b.ckpt'}")
    arguments.append(f"inference={tmp_path / 'b.ckpt'}")
    assert ghgs("export", *arguments) == 1
    expected = "inference: expected a path where there is no file, or overwrite=true"
    assert expected in capsys.readouterr().err
    assert ghgs("export", *arguments, "overwrite=true") == 0


def test_what_half_precision_cannot_hold_is_refused(tmp_path):
    path, state = tmp_path / "a.ckpt", make_model().state_dict()
    name = next(name for name in state if name.startswith("gaussian_head"))
    state[name] = torch.full_like(state[name], 1e6)
    write_checkpoint(path, state, config())
    with pytest.raises(InputError, match=rf"a\.ckpt as float16: {name}: expected finite numbers"):
        write_inference(path, tmp_path / "b.ckpt", "float16")
    write_inference(path, tmp_path / "b.ckpt", "bfloat16")
    with pytest.raises(InputError, match="expected another file than the checkpoint"):
        write_inference(path, path, "float16")


@pytest.mark.parametrize("has_bfloat16", [True, False])
@pytest.mark.parametrize("stored", [torch.float16, torch.bfloat16, torch.float32])
def test_half_precision_is_computed_where_the_processor_has_it(
    trained, tmp_path, monkeypatch, stored, has_bfloat16
):
    """A float16 encoder is slow on a CPU, which loads float32; a GPU keeps float16, and so does an
    explicit request."""
    monkeypatch.setattr(precision, "has_bfloat16", lambda _: has_bfloat16)
    write_inference(trained, tmp_path / "b.ckpt", str(stored).removeprefix("torch."))
    kept = stored == torch.bfloat16 and has_bfloat16
    model, asked = (load_model(tmp_path / "b.ckpt", dtype=dtype) for dtype in (None, stored))
    assert {p.dtype for p in model.encoder.parameters()} == {stored if kept else torch.float32}
    assert {p.dtype for p in asked.encoder.parameters()} == {stored}
    elsewhere = load_model(tmp_path / "b.ckpt", map_location="meta")
    assert {p.dtype for p in elsewhere.encoder.parameters()} == {stored}
    for name, tensor in model_state(read_checkpoint(tmp_path / "b.ckpt")).items():
        assert torch.equal(model.state_dict()[name].float(), tensor.float())


def test_the_weights_of_the_package_are_exported_by_name(tmp_path, monkeypatch, capsys):
    """``checkpoint=shipped`` is not a file's path."""
    monkeypatch.chdir(tmp_path)
    assert ghgs("export", "checkpoint=shipped", "inference=half.ckpt", "dtype=float16") == 0
    assert re.search(r"^[\d.]+ MB to [\d.]+ MB$", capsys.readouterr().out, re.MULTILINE)
    assert (tmp_path / "half.ckpt").stat().st_size < 2.5e6
