"""Rendered boxes, which all tests of measuring read."""

import pytest
import torch

from tests.helpers.people import render_boxes


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Images this small gain nothing from threads, and lose much where the cores are shared."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def boxes(tmp_path_factory):
    """The root of three people to train on and two to measure."""
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "rendered", folder / "scans", train=3, val=2)
    return folder / "rendered"
