"""Models without a published form, and paths that no file can have."""

import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.weights.checkpoint import write_checkpoint
from ghgs_lit.weights.exporting import export_weights
from tests.helpers.models import config, make_model


def a_checkpoint(path, *overrides):
    write_checkpoint(path, make_model(*overrides).state_dict(), config(*overrides))
    return path


def test_a_model_without_a_published_form_says_so_and_what_differs(tmp_path):
    """A tensor's name alone does not tell that no model of this kind can be exported;
    nothing is written."""
    path = a_checkpoint(tmp_path / "hull.ckpt", "model=hull")
    said = r"hull\.ckpt: expected a model of the release's form .*gaussian_head\.guide=True for False"
    with pytest.raises(InputError, match=said) as error:
        export_weights(path, tmp_path / "vggt.pt", tmp_path / "release.pth")
    assert "\n" not in str(error.value)
    assert [file.name for file in tmp_path.iterdir()] == ["hull.ckpt"]


def test_a_directory_is_no_file_to_export_to(tmp_path):
    """The path is named in one line, not in a traceback."""
    path = a_checkpoint(tmp_path / "paper.ckpt", "model=paper")
    (tmp_path / "folder").mkdir()
    with pytest.raises(InputError, match=r"folder: expected a file to write; found 'a directory'"):
        export_weights(path, tmp_path / "folder", None)
    assert export_weights(path, tmp_path / "vggt.pt", None)
    assert torch.load(tmp_path / "vggt.pt", weights_only=True)
