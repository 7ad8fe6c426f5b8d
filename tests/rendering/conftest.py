"""Fixture: tests of the renderer start with one thread, and without capacities of earlier renderings."""

import pytest

from ghgs_lit.rendering import capacity


@pytest.fixture(autouse=True)
def _fresh(one_thread):
    capacity._expected.clear()
