"""Small tensors: more threads would only wait for one another."""

import pytest


@pytest.fixture(autouse=True)
def _fresh(one_thread):
    """Every test of this folder has one thread."""
