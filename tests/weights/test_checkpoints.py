"""Checkpoints rebuild their models; files that do not fit are refused by name."""

import os
import pickle
import warnings
from pathlib import Path

import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import save_file

from ghgs_lit.cli.inputs import with_trained_data
from ghgs_lit.config import run_of
from ghgs_lit.errors import InputError
from ghgs_lit.training.optimization import Optimization
from ghgs_lit.weights.checkpoint import FORMAT_VERSION, read_config, write_checkpoint
from ghgs_lit.weights.frozen import SHARING
from tests.helpers.models import close, config, load_model, make_model, predict
from tests.helpers.scenes import make_batch


def checkpoint(path, **changes):
    model = make_model()
    content = {
        "state_dict": {f"model.{k}": v for k, v in model.state_dict().items()}
        | {"loss.weight": torch.ones(1)},
        "config": config(),
        "format_version": FORMAT_VERSION,
    }
    torch.save({k: v for k, v in (content | changes).items() if v is not None}, path)
    return model


def test_a_checkpoint_rebuilds_its_model(tmp_path):
    """A checkpoint alone must give the same Gaussians, without any YAML."""
    model = checkpoint(tmp_path / "a.ckpt").eval()
    loaded = load_model(tmp_path / "a.ckpt")
    assert not loaded.training
    batch = make_batch(1, 3)
    with torch.no_grad():
        close(predict(loaded, batch).gaussians, predict(model, batch).gaussians, 0)


def test_a_checkpoint_that_does_not_fit_names_key_and_shapes(tmp_path):
    """Weights of another model must not load in part."""
    path = tmp_path / "a.ckpt"
    checkpoint(path, config=config("gaussian_head.hidden=[64,32]"))
    with pytest.raises(
        InputError, match=r"a\.ckpt: gaussian_head\.\w+_header\.0\.weight.*\(64, 16\).*\(32, 16\)"
    ):
        load_model(path)
    checkpoint(path, state_dict={})
    with pytest.raises(InputError, match=r"a\.ckpt: encoder.*expected a tensor of shape"):
        load_model(path)


class Foreign:
    """An object whose pickle calls a function."""

    def __reduce__(self):
        return os.system, ("false",)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"config": None}, "'config'"),
        ({"state_dict": None}, "'state_dict'"),
        ({"format_version": None}, "'format_version'"),
        ({"format_version": SHARING + 1}, "of a newer version"),
        ({"format_version": 0}, "format_version 1 to"),
        ({"config": {"encoder": {}}}, "bounds"),
        (
            {"config": {**config(), "encoder": "vggt_nano"}},
            r"encoder: expected a mapping .*; found 'vggt_nano'",
        ),
    ],
)
def test_a_foreign_file_is_refused_by_its_path(tmp_path, changes, message):
    """A file without the keys of a checkpoint must be named, not end in a KeyError."""
    path = tmp_path / "b.ckpt"
    checkpoint(path, **changes)
    with pytest.raises(InputError, match=message) as error:
        load_model(path)
    assert "b.ckpt" in str(error.value) or "bounds" in message or "encoder" in message


def a_checkpoint(folder):
    checkpoint(folder / "whole.ckpt")
    return (folder / "whole.ckpt").read_bytes()


def a_safetensors(folder):
    save_file(dict(make_model().state_dict()), folder / "whole.safetensors")
    return (folder / "whole.safetensors").read_bytes()


def of_torch(content):
    """The bytes of a file that ``torch.save`` writes."""

    def make(folder):
        torch.save(content, folder / "made.pt")
        return (folder / "made.pt").read_bytes()

    return make


def changed_state(change):
    def make(folder):
        checkpoint(folder / "changed.ckpt")
        content = torch.load(folder / "changed.ckpt", weights_only=True)
        change(content["state_dict"])
        return of_torch(content)(folder)

    return make


TOKEN = "model.encoder.aggregator.camera_token"

#: name: (content, part of the message); docs/evidence/broken_files.md lists the messages.
BAD_FILES = {
    "empty": (lambda _: b"", "found an empty file"),
    "web page": (lambda _: b"<!DOCTYPE html><html><title>Sign in</title>", "found a web page"),
    "git-lfs pointer": (lambda _: b"version https://git-lfs.github.com/spec/v1\noid 0", "git lfs pull"),
    "something else": (lambda _: b"no weights at all", "its first bytes are b'no weights at al'"),
    "truncated .pt": (lambda f: a_checkpoint(f)[:-4000], "end is missing"),
    "truncated .safetensors": (lambda f: a_safetensors(f)[:-4000], "end is missing"),
    "truncated header": (lambda f: a_safetensors(f)[:500], "end is missing"),
    "broken header": (lambda _: (9).to_bytes(8, "little") + b"{nonsense", "invalid JSON"),
    "code": (of_torch({"state_dict": Foreign()}), r"code \(\w+\.system\), which is never run"),
    "pickled code": (lambda _: pickle.dumps(Foreign()), "found a pickle that PyTorch did not write"),
    "a plain pickle": (lambda _: pickle.dumps([1, 2]), "found a pickle that PyTorch did not write"),
    "foreign state dict": (of_torch({"layer.weight": torch.ones(2)}), r"'state_dict'; found 'layer\.weight'"),
    "a safetensors model": (a_safetensors, r"'state_dict'; found 'depth_head.* and \d+ more"),
    "published weights": (of_torch({"network": {}, "optimizer": {}}), "`ghgs import` makes a checkpoint"),
    "a bare tensor": (of_torch(torch.ones(2)), "'state_dict'; found a Tensor"),
    "wrong shape": (
        changed_state(lambda s: s.update({TOKEN: torch.ones(3)})),
        r"camera_token: expected shape \(1, 2, 1, 32\) .*; found \(3,\)",
    ),
    "missing key": (changed_state(lambda s: s.pop(TOKEN)), "camera_token: expected a .*; found 'nothing'"),
    "extra key": (changed_state(lambda s: s.update({"model.x": torch.ones(3)})), "x: expected no such key"),
    "no tensor": (changed_state(lambda s: s.update({TOKEN: 3})), "camera_token: .* found 'int'"),
    "not finite": (
        changed_state(lambda s: s.update({TOKEN: torch.full((1, 2, 1, 32), float("nan"))})),
        "camera_token: expected finite numbers; found 'NaN or infinity'",
    ),
    "infinite": (
        changed_state(lambda s: s[TOKEN].view(-1)[3].fill_(float("inf"))),
        "camera_token: expected finite numbers; found 'NaN or infinity'",
    ),
    "whole numbers": (
        changed_state(lambda s: s.update({TOKEN: torch.ones(1, 2, 1, 32).int()})),
        "expected floating point numbers; found torch.int32",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_FILES)
def test_every_bad_file_is_answered_by_one_line(tmp_path, name):
    """Failed downloads and pickled code must be explained, and never be executed."""
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
    """A wrong path must be named in one line."""
    with pytest.raises(FileNotFoundError, match=r"c\.ckpt: expected a file of weights; found none"):
        load_model(tmp_path / "c.ckpt")
    with pytest.raises(InputError, match="found a directory"):
        load_model(tmp_path)


def test_weights_are_mapped_and_can_be_trained(tmp_path):
    """Loading must not copy 4 GB, and training must not write to the mapped file."""
    path = tmp_path / "a.ckpt"
    checkpoint(path)
    before = path.read_bytes()
    model = load_model(path)
    assert not any(t.is_meta for t in (*model.parameters(), *model.buffers()))
    mapped = Path("/proc/self/maps")
    if mapped.exists():
        assert str(path) in mapped.read_text()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1)
    assert path.read_bytes() == before
    path.unlink()
    assert all(p.isfinite().all() for p in model.parameters())


@pytest.mark.parametrize("trainable", ["none", "last_1", "last_2", "all"])
def test_a_loaded_model_trains_what_its_encoder_says(tmp_path, trainable):
    """``encoder.trainable`` must decide which parameters get gradients and are in the optimizer."""
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
    """``${sqlite:...}`` in the data of a checkpoint made folders:
    verbs merge it into their configuration."""
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


def loop():
    """A mapping that holds itself."""
    node = {"kind": "scans"}
    node["split"] = [node]
    return node


def doubled(levels=40):
    """A few hundred bytes that are a billion values when they are written out."""
    node = {"a": 1}
    for _ in range(levels):
        node = {"a": node, "b": node}
    return node


@pytest.mark.parametrize("many", [loop(), {"kind": "scans", "x": doubled(20)}, doubled(60)])
def test_a_configuration_without_end_is_refused(tmp_path, many):
    """PyTorch's files may hold references; recursion and memory ended in tracebacks,
    or not at all."""
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


def test_a_configuration_is_read_again_where_its_file_has_changed(tmp_path):
    """Commands ask several times, and a sweep's next run may have replaced the file."""
    path, found = tmp_path / "a.ckpt", []
    for width in (32, 32, 48):
        write_checkpoint(path, {}, {"encoder": {"width": width}})
        found.append(read_config(path))
        found[-1]["encoder"]["heads"] = 2  # a caller's own copy
    assert [each["encoder"]["width"] for each in found] == [32, 32, 48]
    assert read_config(path) == {"encoder": {"width": 48}}
    path.unlink()
    with pytest.raises(FileNotFoundError):
        read_config(path)
