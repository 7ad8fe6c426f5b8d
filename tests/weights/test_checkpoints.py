"""Checkpoints rebuild their models; files that do not fit are rejected by name."""

import os
import pickle
import warnings
from pathlib import Path

import lightning.pytorch
import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import save_file

from ghgs_lit.cli.inputs import with_trained_data
from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.training.checkpoints import AtomicCheckpointIO
from ghgs_lit.training.optimization import Optimization
from ghgs_lit.training.start import check_resume, initialize
from ghgs_lit.weights.checkpoint import (
    read_config,
)
from ghgs_lit.weights.frozen import SHARING
from tests.helpers.checkpoints import checkpoint, content
from tests.helpers.models import close, config, load_model, make_model, predict
from tests.helpers.scenes import make_batch
from tests.helpers.training import held


def test_a_checkpoint_rebuilds_its_model_without_any_yaml(tmp_path):
    """The model predicts the same Gaussians; weights are memory-mapped, and training does not write to
    the file."""
    path, model = checkpoint(tmp_path / "a.ckpt"), make_model().eval()
    before, loaded = path.read_bytes(), load_model(path)
    assert not loaded.training
    assert not any(t.is_meta for t in (*loaded.parameters(), *loaded.buffers()))
    batch = make_batch(1, 3)
    with torch.no_grad():
        close(predict(loaded, batch).gaussians, predict(model, batch).gaussians, 0)
        mapped = Path("/proc/self/maps")
        if mapped.exists():
            assert str(path) in mapped.read_text()
        for parameter in loaded.parameters():
            parameter.add_(1)
    assert path.read_bytes() == before


class Foreign:
    """An object whose pickle calls a function."""

    def __reduce__(self):
        return os.system, ("false",)


def a_checkpoint(folder):
    return checkpoint(folder / "whole.ckpt").read_bytes()


def a_safetensors(folder):
    save_file(dict(make_model().state_dict()), folder / "whole.safetensors")
    return (folder / "whole.safetensors").read_bytes()


def of_torch(content):
    """Bytes of a file written by ``torch.save``."""

    def make(folder):
        torch.save(content, folder / "made.pt")
        return (folder / "made.pt").read_bytes()

    return make


def edit(**changes):
    """Bytes of a checkpoint with other entries."""
    return lambda folder: checkpoint(folder / "changed.ckpt", **changes).read_bytes()


def changed_state(change):
    def make(folder):
        made = content()
        change(made["state_dict"])
        return of_torch(made)(folder)

    return make


TOKEN = "model.encoder.aggregator.camera_token"
TENSOR = torch.ones(2, 2)

#: name: (content, part of the message); docs/evidence/broken_files.md lists the messages.
BAD_FILES = {
    "empty": (lambda _: b"", "found an empty file"),
    "web page": (lambda _: b"<!DOCTYPE html><html><title>Sign in", "first bytes are b'<!DOCTYPE html>"),
    "git-lfs pointer": (lambda _: b"version https://git-lfs.github.com/spec/v1\noid 0", "b'version https:/"),
    "truncated .pt": (lambda f: a_checkpoint(f)[:-4000], "end is missing"),
    "truncated .safetensors": (lambda f: a_safetensors(f)[:-4000], "cannot be read .*not fully covered"),
    "broken header": (lambda _: (9).to_bytes(8, "little") + b"{nonsense", "invalid JSON"),
    "code": (of_torch({"state_dict": Foreign()}), r"code \(\w+\.system\), which is never run"),
    "pickled code": (lambda _: pickle.dumps(Foreign()), "found a pickle with code"),
    "a plain pickle": (lambda _: pickle.dumps([1, 2]), "found a pickle with code"),
    "foreign state dict": (of_torch({"layer.w": torch.ones(2)}), r"'state_dict'.*; found 'layer\.w'"),
    "a safetensors model": (a_safetensors, r"'state_dict'.*; found 'depth_head.* and \d+ more"),
    "published weights": (of_torch({"network": {}, "optimizer": {}}), "`ghgs import` makes one"),
    "a bare tensor": (of_torch(torch.ones(2)), "'state_dict'.*; found a Tensor"),
    "no config": (edit(config=None), "'config'"),
    "no version": (edit(format_version=None), "'format_version'"),
    "newer": (edit(format_version=SHARING + 1), "of a newer version"),
    "version 0": (edit(format_version=0), "format_version 1 to"),
    "other model": (
        edit(config=config("gaussian_head.hidden=[64,32]")),
        r"gaussian_head\.\w+_header\.0\.weight.*\(64, 16\).*\(32, 16\)",
    ),
    "no tensors": (edit(state_dict={}), "encoder.*expected a tensor of shape"),
    "wrong shape": (
        changed_state(lambda s: s.update({TOKEN: torch.ones(3)})),
        r"camera_token: expected shape \(1, 2, 1, 32\) .*; found \(3,\)",
    ),
    "missing key": (changed_state(lambda s: s.pop(TOKEN)), "camera_token: expected a .*; found 'nothing'"),
    "extra key": (changed_state(lambda s: s.update({"model.x": torch.ones(3)})), "x: expected no such key"),
    "no tensor": (changed_state(lambda s: s.update({TOKEN: 3})), "camera_token: .* found 'int'"),
    "infinite": (
        changed_state(lambda s: s[TOKEN].view(-1)[3].fill_(float("inf"))),
        "camera_token: expected finite numbers; found 'NaN or infinity'",
    ),
    "not finite": (
        changed_state(lambda s: s[TOKEN].view(-1)[3].fill_(float("nan"))),
        "camera_token: expected finite numbers; found 'NaN or infinity'",
    ),
    "whole numbers": (
        changed_state(lambda s: s.update({TOKEN: torch.ones(1, 2, 1, 32).int()})),
        "expected floating point numbers; found torch.int32",
    ),
    "no names": (edit(state_dict={3: TENSOR}), "state_dict: expected names of tensors; found 3"),
    "sparse": (edit(state_dict={"model.a": TENSOR.to_sparse()}), "model.a: expected a dense tensor"),
    "on no device": (edit(state_dict={"model.a": TENSOR.to("meta")}), "model.a: expected a dense tensor"),
    "8 bits": (edit(state_dict={"model.a": TENSOR.to(torch.float8_e4m3fn)}), "model.a: .*float8"),
    "expanded": (
        edit(state_dict={"model.a": torch.zeros(1).expand(1 << 40)}),
        "model.a: expected as many bytes as .*; found 4",
    ),
    "config of numbers": (edit(config={3: {}}), "config: expected keys of text; found 3"),
    **{
        f"config.{node}": (
            edit(config={**config(), node: value}),
            rf"config\.{node}: expected a mapping",
        )
        for node, value in (("data", []), ("model", "text"), ("skip", 3), ("encoder", "vggt_nano"))
    },
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_every_bad_file_is_answered_by_one_line(tmp_path, name):
    """Failed downloads and pickled code raise a one-line error, and code is never executed."""
    make, message = BAD_FILES[name]
    path = tmp_path / "bad.ckpt"
    path.write_bytes(make(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match=message) as error:
            load_model(path)
    text = str(error.value)
    assert text.startswith(f"{path}: ")
    assert "expected" in text
    assert "found" in text
    assert "\n" not in text


def test_a_path_without_a_file_is_refused(tmp_path):
    """A wrong path is named in one line."""
    with pytest.raises(FileNotFoundError, match=r"c\.ckpt: expected a file of weights; found none"):
        load_model(tmp_path / "c.ckpt")
    with pytest.raises(InputError, match="found a directory"):
        load_model(tmp_path)
    with pytest.raises(InputError, match="bounds"):
        load_model(checkpoint(tmp_path / "a.ckpt", config={"encoder": {}}))


@pytest.mark.parametrize("trainable", ["none", "last_1", "last_2", "all"])
def test_a_loaded_model_trains_what_its_encoder_says(tmp_path, trainable):
    """``encoder.trainable`` determines which parameters get gradients and are in the optimizer."""
    path = tmp_path / "a.ckpt"
    checkpoint(path, config=config(f"encoder.trainable={trainable}"))
    model = load_model(path).train()
    optimizer = Optimization(lr=1e-3).optimizer(model)
    held = {id(p) for group in optimizer.param_groups for p in group["params"]}
    before = {name: p.detach().clone() for name, p in model.named_parameters()}
    g = predict(model, make_batch(1, 3)).gaussians
    (g.means.square().mean() + g.scales.mean() + g.opacities.mean() + g.quaternions[:, 1].mean()).backward()
    depth = len(model.encoder.aggregator.frame_blocks)
    count = {"none": 0, "all": depth}.get(trainable) or int("0" + trainable[5:])
    blocks = [f"{kind}_blocks.{i}." for kind in ("frame", "global") for i in range(depth - count, depth)]
    last = tuple(f"encoder.aggregator.{block}" for block in blocks)
    for name, parameter in model.named_parameters():
        trained = not name.startswith("encoder.") or trainable == "all" or name.startswith(last)
        assert parameter.requires_grad == trained == (id(parameter) in held), name
        assert trained or parameter.grad is None, name
    optimizer.step()
    for name, parameter in model.named_parameters():
        moved = not torch.equal(parameter, before[name])
        assert moved == (parameter.grad is not None and bool(parameter.grad.any())), name
    encoder = [n for n, p in model.named_parameters() if n.startswith("encoder.") and p.grad is not None]
    assert bool(encoder) == (trainable != "none")


@pytest.mark.parametrize("verb", ["evaluate", "predict"])
def test_no_resolver_of_a_checkpoint_is_evaluated(tmp_path, verb):
    """Regression: ``${sqlite:...}`` in a checkpoint created folders, because commands merge it into their
    configuration."""
    path, called = tmp_path / "a.ckpt", []
    OmegaConf.register_new_resolver("called", called.append, replace=True)
    for node in (
        {"kind": "scans", "root": "${called:1}"},
        {"kind": "scans", "split": {"val": ["${called:1}"]}},
    ):
        checkpoint(path, config={**config(), "data": node})
        with pytest.raises(
            InputError, match=r"a\.ckpt: config\.data\.\w+(\.val)?: expected a value, no interp"
        ):
            with_trained_data(run_of(verb, [f"checkpoint={path}"]))
    assert called == []


def cyclic_mapping():
    """A mapping that contains itself."""
    node = {"kind": "scans"}
    node["split"] = [node]
    return node


def nest(levels=40):
    """A few hundred bytes that expand to a billion values."""
    node = {"a": 1}
    for _ in range(levels):
        node = {"a": node, "b": node}
    return node


@pytest.mark.parametrize("many", [cyclic_mapping(), {"kind": "scans", "x": nest(20)}, nest(60)])
def test_a_configuration_without_end_is_refused(tmp_path, many):
    """Regression: references in PyTorch's files led to tracebacks about recursion or memory, or no end at
    all."""
    path = tmp_path / "a.ckpt"
    checkpoint(path, config={**config(), "data": many})
    with pytest.raises(InputError, match=r"a\.ckpt: config\.data.*: expected less than 32 levels and 100000"):
        read_config(path)


def test_a_configuration_of_other_things_than_yaml_says_is_refused(tmp_path):
    path = tmp_path / "a.ckpt"
    for value, said in ((torch.ones(2), "Tensor"), ({1: 2}, "keys of text; found 1")):
        checkpoint(path, config={**config(), "data": {"x": [value]}})
        with pytest.raises(InputError, match=rf"a\.ckpt: config\.data\.x: expected .*{said}"):
            read_config(path)


def test_weights_in_double_precision_are_read_in_single(tmp_path):
    """Converters and runs with ``trainer.precision=64-true`` write float64; the model computes in float32."""
    made = content()
    double = {key: value.double() for key, value in made["state_dict"].items() if value.is_floating_point()}
    torch.save({**made, "state_dict": {**made["state_dict"], **double}}, tmp_path / "a.ckpt")
    model = load_model(tmp_path / "a.ckpt")
    assert {p.dtype for p in model.parameters()} == {torch.float32}
    for key, value in model.state_dict().items():
        assert torch.equal(value, made["state_dict"][f"model.{key}"])
    initialize(started := make_model(), tmp_path / "a.ckpt")
    assert {p.dtype for p in started.parameters()} == {torch.float32}
    too_large = {**double, next(iter(double)): next(iter(double.values())) + 1e300}
    torch.save({**made, "state_dict": {**made["state_dict"], **too_large}}, tmp_path / "a.ckpt")
    with pytest.raises(InputError, match=r"a\.ckpt: .*: expected finite numbers"):
        load_model(tmp_path / "a.ckpt")


@pytest.mark.parametrize(("key", "value"), [("global_step", "5"), ("optimizer_states", {})])
def test_a_state_of_training_of_another_form_is_refused(tmp_path, key, value):
    torch.save(content(**{key: value}), tmp_path / "a.ckpt")
    with pytest.raises(InputError, match=rf"a\.ckpt: {key}.*: expected .*; found"):
        check_resume(tmp_path / "a.ckpt", held(make_model()), config())


@pytest.mark.parametrize("version", [{}, *({"pytorch-lightning_version": odd} for odd in ("x", 3, None))])
def test_a_missing_or_odd_version_of_lightning_is_this_one(tmp_path, version):
    """Lightning would otherwise try to parse it."""
    torch.save(content(**version), tmp_path / "a.ckpt")
    loaded = AtomicCheckpointIO().load_checkpoint(tmp_path / "a.ckpt")
    assert loaded["pytorch-lightning_version"] == lightning.pytorch.__version__
