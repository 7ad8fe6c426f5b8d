"""The pretend device for captured predictions and training steps."""

import pytest
import torch

from benchmarks.device import render_nothing
from tests.helpers.pretend_device import pretend_device


@pytest.fixture
def there(one_thread):
    """The log of the pretend device, on which nothing is rendered."""
    with pretend_device() as log, render_nothing():
        yield log


@pytest.fixture
def no_gradient():
    with torch.no_grad():
        yield
