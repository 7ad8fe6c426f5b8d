"""Rendered boxes for all tests of evaluation."""

import pytest
import torch

from tests.helpers.people import render_boxes


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Run on one thread: small images gain nothing from more, and lose much where cores are shared."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def boxes(tmp_path_factory):
    """Root of a data set with three people for training and two for validation."""
    folder = tmp_path_factory.mktemp("boxes")
    render_boxes(folder / "rendered", folder / "scans", train=3, val=2)
    return folder / "rendered"
