"""The photographs of ``benchmarks/captures.py``."""

import dataclasses
import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.helpers.scenes import make_batch, with_soft_rims

SCRIPT = Path(__file__).parents[3] / "benchmarks" / "captures.py"


@pytest.fixture(scope="module")
def script():
    return runpy.run_path(str(SCRIPT))


@pytest.fixture(scope="module")
def person():
    batch = with_soft_rims(make_batch(1, 4, 84, 84))
    views = (("front", "left", "back", "right"),)
    return dataclasses.replace(
        batch, images=batch.images * batch.alpha[:, :, None], views=views, subjects=("p1",)
    )


def test_each_trouble_comes_alone(script, person):
    """Each capture differs from the exact one by its trouble only; the last one has all of them."""
    exact = script["photograph"](script["CAPTURES"]["clean"], person).photographs
    for v, photograph in enumerate(exact):
        assert np.abs(photograph.matte / 255 - person.alpha[0, v].numpy()).max() < 1 / 255
        shown = person.images[0, v].movedim(0, -1).numpy() * 255
        full = person.alpha[0, v].numpy() == 1
        assert np.abs(photograph.image - shown)[full].max() <= 1
        assert (photograph.image[person.alpha[0, v].numpy() == 0].std(0) > 3).all()
        assert torch.equal(torch.from_numpy(photograph.extrinsics).float(), person.cameras.extrinsics[0, v])

    def differs(name):
        found = script["photograph"](script["CAPTURES"][name], person).photographs
        parts = ("image", "matte", "intrinsics", "extrinsics")
        return {
            part
            for part in parts
            if any((getattr(a, part) != getattr(b, part)).any() for a, b in zip(exact, found, strict=True))
        }

    assert differs("exposure, white balance") == {"image"}
    assert differs("masks in place of mattes") == {"matte"}
    assert differs("masks off and ragged") == differs("masks with holes") == {"matte"}
    assert differs("calibration up to 3 px") == {"intrinsics", "extrinsics"}
    assert differs("all at once") == {"image", "matte", "intrinsics", "extrinsics"}


def test_masks_are_whole_numbers_and_wrong_where_asked(script, person):
    exact, ragged, holed = (
        np.stack([one.matte for one in script["photograph"](script["CAPTURES"][name], person).photographs])
        for name in ("masks in place of mattes", "masks off and ragged", "masks with holes")
    )
    assert all(set(np.unique(masks)) == {0, 255} for masks in (exact, ragged, holed))
    assert (exact == 255 * person.masks[0].numpy()).all()
    assert (holed <= exact).all()
    assert (holed < exact).any()
    assert (ragged > exact).any()
    assert (ragged < exact).any()
