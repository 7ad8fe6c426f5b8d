"""Batches that the model rejects, and the error messages."""

import dataclasses

import pytest
import torch

from ghgs_lit.errors import InputError
from tests.helpers.models import make_model, predict
from tests.helpers.scenes import make_batch


def spoil(name, index, value):
    """A field with a bad value; of the cameras where they have it."""
    batch = make_batch(1, 2)
    owner = batch.cameras if hasattr(batch.cameras, name) else batch
    tensor = getattr(owner, name).clone()
    tensor[index] = value
    changed = {name: tensor}
    return changed if owner is batch else {"cameras": dataclasses.replace(owner, **changed)}


NAN = torch.nan


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
        (vars(make_batch(1, 1)), "2 views"),
        (vars(make_batch(1, 2, 56, 50)), "divisible by the patch size 14"),
        ({"cameras": dataclasses.replace(make_batch(1, 2).cameras, height=28)}, "the images' size"),
        (spoil("extrinsics", (0, 1, 0, 3), NAN), r"cameras.extrinsics: expected finite .*found .*\[0, 1\]"),
        (spoil("intrinsics", (0, 1, 1, 1), -3.0), r"focal lengths above 0; found .*\[0, 1\]"),
        (spoil("masks", 0, False), r"batch.masks: expected the subject in one view.*\[0\]"),
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
