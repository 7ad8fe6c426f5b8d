"""Batches that the model rejects, and the error messages."""

import dataclasses
import functools

import pytest
import torch

from ghgs_lit.errors import InputError
from ghgs_lit.execution import Predictor
from ghgs_lit.execution.preprocessing import findings_of, raise_violation
from ghgs_lit.types import Batch
from tests.helpers.models import make_model, predict
from tests.helpers.scenes import make_batch


@functools.cache
def bad_batches():
    batch = make_batch(2, 3)
    cameras = batch.cameras

    def with_cameras(**changes):
        return dataclasses.replace(batch, cameras=dataclasses.replace(cameras, **changes))

    def changed(tensor, index, value):
        tensor = tensor.clone()
        tensor[index] = value
        return tensor

    one = Batch(batch.images[:, :1], batch.masks[:, :1], cameras[:, :1])
    odd = make_batch(1, 2, 56, 50)
    return {
        "2 views": one,
        "divisible by the patch size 14": odd,
        "the images' size": with_cameras(height=28),
        r"batch.cameras.extrinsics: expected finite values; found .*\[1, 2\]": with_cameras(
            extrinsics=changed(cameras.extrinsics, (1, 2, 0, 3), float("nan"))
        ),
        r"focal lengths above 0; found .*\[0, 1\]": with_cameras(
            intrinsics=changed(cameras.intrinsics, (0, 1, 1, 1), -3.0)
        ),
        r"batch.masks: expected the subject in one view.*\[1\]": dataclasses.replace(
            batch, masks=changed(batch.masks, 1, False)
        ),
    }


def spoil(name, index, value):
    tensor = getattr(make_batch(1, 2), name).clone()
    tensor[index] = value
    return {name: tensor}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (spoil("images", (0, 1, 2, 0, 0), torch.nan), r"batch.images: expected finite .*\[\[0, 1\]\]"),
        (spoil("images", (0, 0, 0, 0, 0), torch.inf), r"batch.images: .*\[\[0, 0\]\]"),
        (spoil("images", (0, 0, 0, 0, 0), 255.0), r"batch.images: .*within \[0, 1\]"),
        (spoil("images", (0, 0, 0, 0, 0), -0.5), r"batch.images: .*within \[0, 1\]"),
        (spoil("depths", (0, 1, 3, 3), torch.nan), r"batch.depths: .*\[\[0, 1\]\]"),
        (spoil("depths", (0, 1, 3, 3), -1.0), r"batch.depths: expected finite depths"),
        ({"alpha": torch.full((1, 2, 56, 56), 1.2)}, r"batch.alpha: expected finite values within \[0, 1\]"),
        ({"alpha": torch.zeros(1, 2, 56, 28)}, r"batch.alpha: expected .*; found \(1, 2, 56, 28\)"),
        ({"depths": torch.zeros(1, 2, 28, 56)}, r"batch.depths: expected .*; found \(1, 2, 28, 56\)"),
        ({"log_gains": torch.zeros(1, 2)}, r"batch.log_gains: expected \(1, 2, 3\); found \(1, 2\)"),
        ({"images": torch.zeros(1, 2, 4, 56, 56)}, r"batch.images: expected \[B, V, 3, H, W\]; found"),
        ({"alpha": torch.zeros(1, 2, 56, 56, dtype=torch.bool)}, r"batch.alpha: .*torch.bool"),
        ({"body_vertices": [torch.tensor([[0.0, torch.nan, 0.0]])]}, r"batch.body_vertices: .*\[\[0\]\]"),
        ({"images": torch.zeros(1, 2, 3, 56, 56, dtype=torch.uint8)}, r"batch.images: .*torch.uint8"),
        ({"masks": torch.ones(1, 2, 56, 56, dtype=torch.uint8)}, r"batch.masks: .*torch.uint8"),
    ],
)  # fmt: skip
def test_broken_values_are_refused_where_they_are(changes, message):
    """Regression: one NaN in the background silently removed all Gaussians; uint8 images gave colours of
    254."""
    batch = make_batch(1, 2)
    for name, value in changes.items():
        object.__setattr__(batch, name, value)  # the shape checks of types run only in tests
    model = make_model("model=paper")
    with pytest.raises(InputError, match=message):
        predict(model, batch)


def test_checks_of_values_can_be_left_out():
    """Checks can be disabled for values that are already checked; by default the model rejects invalid
    ones."""
    bad = dataclasses.replace(make_batch(1, 2), **spoil("images", (0, 1, 2, 0, 0), torch.nan))
    model = make_model("model=paper")
    with pytest.raises(InputError, match=r"batch\.images: expected finite values within \[0, 1\]"):
        predict(model, bad)
    Predictor(model, checks_values=False)(bad)


@pytest.mark.parametrize("message", list(bad_batches()))
def test_a_bad_batch_is_refused_by_name(message):
    """Invalid input is rejected with the name of the field."""
    with pytest.raises(InputError, match=message):
        raise_violation(findings_of(bad_batches()[message], 14))
