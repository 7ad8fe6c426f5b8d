"""Checkpoints rebuild their models; what does not fit is refused by name."""

import pickle

import pytest
import torch
from stage_models import close, config, make_model
from stage_scenes import make_batch

from ghgs_lit.errors import InputError
from ghgs_lit.model import FORMAT_VERSION, GHGS


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
    model = checkpoint(tmp_path / "a.ckpt").eval()
    loaded = GHGS.from_checkpoint(tmp_path / "a.ckpt")
    assert not loaded.training
    batch = make_batch(1, 3)
    with torch.no_grad():
        close(loaded(batch).gaussians, model(batch).gaussians, 0)


def test_a_checkpoint_that_does_not_fit_names_key_and_shapes(tmp_path):
    path = tmp_path / "a.ckpt"
    checkpoint(path, config=config("gaussian_head.hidden=[64,32]"))
    with pytest.raises(
        InputError, match=r"a\.ckpt: gaussian_head\.\w+_header\.0\.weight.*\(64, 16\).*\(32, 16\)"
    ):
        GHGS.from_checkpoint(path)
    checkpoint(path, state_dict={})
    with pytest.raises(InputError, match=r"a\.ckpt: encoder.*expected a tensor of shape"):
        GHGS.from_checkpoint(path)


class Foreign:
    pass


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"config": None}, "'config'"),
        ({"state_dict": None}, "'state_dict'"),
        ({"format_version": None}, "'format_version'"),
        ({"format_version": FORMAT_VERSION + 1}, "newer version"),
        ({"config": {"encoder": {}}}, "depth_head"),
        ({"config": Foreign()}, "plain data"),
    ],
)
def test_a_foreign_file_is_refused_by_its_path(tmp_path, changes, message):
    path = tmp_path / "b.ckpt"
    checkpoint(path, **changes)
    with pytest.raises(InputError, match=message) as error:
        GHGS.from_checkpoint(path)
    assert "b.ckpt" in str(error.value) or "depth_head" in message


def test_files_that_are_no_checkpoints(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"c\.ckpt"):
        GHGS.from_checkpoint(tmp_path / "c.ckpt")
    (tmp_path / "c.ckpt").write_bytes(b"no checkpoint at all")
    with pytest.raises(InputError, match=r"c\.ckpt"):
        GHGS.from_checkpoint(tmp_path / "c.ckpt")
    (tmp_path / "c.ckpt").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(InputError, match=r"c\.ckpt"):
        GHGS.from_checkpoint(tmp_path / "c.ckpt")
