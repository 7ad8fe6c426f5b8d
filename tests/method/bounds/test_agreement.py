"""A mask that contradicts all others does not vote; consistent masks all vote."""

import dataclasses

import pytest
import torch

from ghgs_lit.method.bounds import SubjectBox, VisualHull
from ghgs_lit.method.bounds.box import RESOLUTION
from ghgs_lit.method.bounds.rays import silhouettes
from tests.helpers.scenes import make_batch


def voting(batch, **options):
    stage = SubjectBox(**options)
    coarse = silhouettes(batch.masks, batch.cameras, RESOLUTION, stage.dilation)
    return stage._select_voting(coarse).tolist()


def spoil(batch, wrong):
    masks = batch.masks.clone()
    size = masks.shape[2]
    if wrong == "noise":
        masks[0, -1] = torch.rand(masks.shape[2:], generator=torch.Generator().manual_seed(0)) < 0.3
    elif wrong == "half":
        masks[0, -1, size // 2 :] = False
    elif wrong == "one pixel":
        masks[0, -1] = False
        masks[0, -1, 3, 5] = True
    elif wrong == "empty":
        masks[0, -1] = False
    elif wrong == "shifted":
        masks[0, -1] = masks[0, -1].roll(size // 3, -1)
    return dataclasses.replace(batch, masks=masks)


@pytest.mark.parametrize("wrong", ["noise", "half", "one pixel", "shifted"])
@pytest.mark.parametrize("views", [3, 4, 5])
@pytest.mark.parametrize("stage", [SubjectBox(), VisualHull()], ids=["box", "hull"])
def test_one_wrong_mask_cuts_nothing_off(stage, views, wrong):
    """The true surface of the other views lies within their bounds."""
    batch = make_batch(1, views, 112, 112)
    spoiled = spoil(batch, wrong)
    assert voting(spoiled) == [[True] * (views - 1) + [False]]
    found = stage(spoiled)
    seen = batch.masks.clone()
    seen[:, -1] = False
    assert (found.near <= batch.depths)[seen].all()
    assert (found.far >= batch.depths)[seen].all()


#: Views, image size, defect of the last mask, options, and which of the views vote.
VOTES = {
    **{
        f"right masks of {views} views": (views, size, None, {}, [True] * views)
        for views in (2, 3, 4, 5)
        for size in ((56, 56), (140, 98))
    },
    "an empty mask takes no vote away": (4, (56, 56), "empty", {}, [True] * 3 + [False]),
    # with two views it is unknown which one is wrong
    "a half of two": (2, (112, 112), "half", {}, [True, True]),
    "a shifted one of two": (2, (112, 112), "shifted", {}, [True, True]),
    # with a tolerance, its vote alone carves nothing; without it, the others would have to agree
    "an outvoted one": (5, (112, 112), "half", {"tolerance": 1}, [True] * 5),
}


@pytest.mark.parametrize("name", VOTES)
def test_which_masks_vote(name):
    views, size, wrong, options, expected = VOTES[name]
    assert voting(spoil(make_batch(1, views, *size), wrong), **options) == [expected]
