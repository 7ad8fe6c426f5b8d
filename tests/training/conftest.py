"""Fixtures of trainings that several test files share."""

import functools

import pytest

from tests.training.test_resume import Cut, fit


@pytest.fixture(scope="session")
def whole(tmp_path_factory):
    """Train once per number of accumulated batches; returns the folder, the module and the
    validations."""

    @functools.cache
    def run(accumulate: int):
        folder, cut = tmp_path_factory.mktemp("whole"), Cut()
        return folder, fit(folder, cut, accumulate_grad_batches=accumulate), cut.validations

    return run
