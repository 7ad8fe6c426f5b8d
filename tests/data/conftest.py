"""Small data sets that all tests of a process share and do not change."""

import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest

from scripts.miniatures import humman, zju_mocap
from tests.helpers.captures import make_miniature
from tests.helpers.people import render_boxes


@pytest.fixture(autouse=True)
def _roomy_disk(monkeypatch):
    """Photographs are packed on disks with room only, whatever the disk of the tests has."""
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(total=100, free=50))


@pytest.fixture(scope="session")
def boxes(tmp_path_factory) -> Path:
    """Rendered boxes: ``s0`` to ``s2`` for training, ``s3`` and ``s4`` for validation."""
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "out", folder / "scans")
    return folder / "out"


@pytest.fixture(scope="session")
def zju_root(tmp_path_factory) -> Path:
    """ZJU-MoCap sequences of both generations, with two frames each."""
    folder = tmp_path_factory.mktemp("zju_mocap")
    make_miniature(zju_mocap, folder, ["386", "313"], 112, seed=3, frames=2)
    return folder


@pytest.fixture(scope="session")
def humman_root(tmp_path_factory) -> Path:
    """HuMMan sequences with three frames, one for validation and one for training."""
    folder = tmp_path_factory.mktemp("humman") / "recon"
    make_miniature(humman, folder, ["p000455_a000986"], {"train": 1, "val": 1}, 160, seed=3)
    return folder
