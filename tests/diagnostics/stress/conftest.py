"""Small tensors: more threads would only wait for one another."""

from tests.rendering.conftest import _one_thread  # noqa: F401  # a fixture for all tests here
