"""Fixture: tests of the renderer start with one thread."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def _one_thread(one_thread):
    """Every test of this folder has one thread."""
