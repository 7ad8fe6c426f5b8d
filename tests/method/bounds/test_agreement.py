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


@pytest.mark.parametrize("views", [2, 3, 4, 5])
@pytest.mark.parametrize("size", [(56, 56), (140, 98)])
def test_right_masks_all_have_a_vote(views, size):
    assert voting(make_batch(2, views, *size)) == [[True] * views] * 2


def test_an_empty_mask_has_no_vote_and_takes_none_away():
    batch = make_batch(1, 4, 56, 56)
    batch.masks[0, 1] = False
    assert voting(batch) == [[True, False, True, True]]


@pytest.mark.parametrize("wrong", ["half", "shifted"])
def test_of_two_views_none_loses_its_vote(wrong):
    """With two views it is unknown which one is wrong."""
    assert voting(spoil(make_batch(1, 2, 112, 112), wrong)) == [[True, True]]


def test_a_wrong_mask_that_is_outvoted_keeps_its_vote():
    """With a tolerance, its vote alone carves nothing; without it, the others would have to agree."""
    spoiled = spoil(make_batch(1, 5, 112, 112), "half")
    assert voting(spoiled) == [[True] * 4 + [False]]
    assert voting(spoiled, tolerance=1) == [[True] * 5]
