"""Rendered boxes for all tests of evaluation."""

import pytest

from tests.helpers.people import render_boxes


@pytest.fixture(scope="module", autouse=True)
def _one_thread(one_thread):
    """Every test of this folder has one thread."""


@pytest.fixture(scope="session")
def boxes(tmp_path_factory):
    """Root of a data set with three people for training and two for validation."""
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "rendered", folder / "scans", train=3, val=2)
    return folder / "rendered"
