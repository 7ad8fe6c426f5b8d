"""Crops around the subject and padding keep geometry and lose nothing."""

import dataclasses

import pytest
import torch

from ghgs_lit.geometry.crop import crops_to_subject, pad_to_patches
from ghgs_lit.geometry.groups import select_elements
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.types import Batch, Cameras


def cameras(b, v, height, width):
    intrinsics = torch.tensor([[90.0, 0, width / 2], [0, 80.0, height / 2 + 3], [0, 0, 1]])
    return Cameras(intrinsics.expand(b, v, 3, 3), torch.eye(4).expand(b, v, 4, 4), height, width)


def boxes(b, v, height, width, seed=0):
    """Random rectangles as masks, some of them touching the border."""
    generator = torch.Generator().manual_seed(seed)
    masks = torch.zeros(b, v, height, width, dtype=torch.bool)
    for index in range(b * v):
        top, left = (int(torch.randint(n - 12, (), generator=generator)) for n in (height, width))
        masks.flatten(0, 1)[index, top : top + 20, left : left + 12] = True
    return masks


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size", [(70, 56), (42, 98)])
def test_crops_hold_the_masks_at_a_multiple_of_the_patch(size, seed):
    """A crop must keep every pixel of the subject and fit the patches."""
    everyone = boxes(2, 3, *size, seed)
    seen = []
    for elements, crop in crops_to_subject(everyone, 14):
        masks = everyone[elements]
        assert crop.height % 14 == crop.width % 14 == 0
        assert crop.height < size[0]
        assert crop.width < size[1]
        assert torch.equal(crop.cut(masks).flatten(2).sum(-1), masks.flatten(2).sum(-1))
        assert torch.equal(crop.paste(crop.cut(masks), False), masks)
        seen += elements.tolist()
    assert sorted(seen) == [0, 1]


def test_points_of_a_cut_batch_are_those_of_the_whole():
    """The cameras of a crop must see the same world points."""
    everyone = boxes(2, 2, 70, 56)
    depths = torch.rand(2, 2, 70, 56) + 1
    images = torch.rand(2, 2, 3, 70, 56)
    whole = Batch(images, everyone, cameras(2, 2, 70, 56), depths=depths)
    for elements, crop in crops_to_subject(everyone, 7):
        masks = everyone[elements]
        part = crop.cut_batch(
            dataclasses.replace(select_elements(whole, None, elements)[0], depths=depths[elements])
        )
        points = crop.paste(unproject_maps(part.depths, part.cameras), 0.0)
        expected = unproject_maps(depths, whole.cameras)[elements]
        assert torch.allclose(points[masks], expected[masks], atol=1e-5)
        pasted = crop.paste(part.images.movedim(2, -1), 0.0)
        assert torch.equal(pasted[masks], images[elements].movedim(2, -1)[masks])


def test_an_empty_mask_and_a_full_one():
    """The extreme masks must still give a valid crop."""
    masks = torch.zeros(1, 2, 28, 28, dtype=torch.bool)
    ((_, crop),) = crops_to_subject(masks, 14, margin=2)
    assert crop.height == 14
    masks[0, 1] = True
    ((_, crop),) = crops_to_subject(masks, 14)
    assert (crop.height, crop.width) == (28, 28)
    assert crop.top.eq(0).all()


def test_a_crop_does_not_depend_on_batch_mates():
    """The largest mask of the batch set one size for all, which moved depths by a centimetre."""
    masks = boxes(4, 3, 98, 98)
    masks[2] = True
    masks[3] = masks[0]
    alone = [crops_to_subject(masks[b : b + 1], 14)[0][1] for b in range(4)]
    groups = crops_to_subject(masks, 14)
    assert any(elements.tolist()[-1] == 3 and len(elements) > 1 for elements, _ in groups)
    for elements, crop in groups:
        for place, element in enumerate(elements.tolist()):
            own = alone[element]
            assert (crop.height, crop.width) == (own.height, own.width)
            assert torch.equal(crop.top[place], own.top[0])
            assert torch.equal(crop.left[place], own.left[0])


def test_a_cut_batch_knows_its_place_in_the_photographs():
    """Positions on the image plane need it, also where a padded photograph is cut."""
    batch = Batch(torch.rand(1, 3, 3, 50, 64), boxes(1, 3, 50, 64), cameras(1, 3, 50, 64))
    padded = pad_to_patches(batch.masks, 14).cut_batch(batch)
    assert padded.corners.tolist() == [[[-3, -3]] * 3]
    ((_, crop),) = crops_to_subject(padded.masks, 14)
    cut = crop.cut_batch(padded)
    moved = batch.cameras.intrinsics[..., :2, 2] - cut.cameras.intrinsics[..., :2, 2]
    assert torch.equal(cut.corners.flip(-1).float(), moved)


@pytest.mark.parametrize(
    ("size", "top", "left", "padded"),
    [((512, 512), -3, -3, (518, 518)), ((360, 640), -2, -2, (364, 644)), ((41, 27), 0, 0, (42, 28))],
)
def test_padding_is_centred_and_undone(size, top, left, padded):
    """512 gets 3 pixels on each side as in the authors' release; a single pixel goes below and right."""
    batch = Batch(torch.rand(1, 2, 3, *size), boxes(1, 2, *size), cameras(1, 2, *size))
    padding = pad_to_patches(batch.masks, 14)
    assert (padding.top, padding.left) == (top, left)
    part = padding.cut_batch(batch)
    assert tuple(part.images.shape[3:]) == tuple(part.masks.shape[2:]) == padded
    assert (part.cameras.height, part.cameras.width) == padded
    assert part.images.sum() == pytest.approx(batch.images.sum().item())
    assert torch.equal(padding.paste(part.masks, True), batch.masks)
    shift = part.cameras.intrinsics - batch.cameras.intrinsics
    assert shift[0, 0, :2, 2].tolist() == [-left, -top]
    depth = torch.rand(1, 2, *padded) + 1
    inside = unproject_maps(padding.paste(depth, 0.0), batch.cameras)
    assert torch.allclose(padding.paste(unproject_maps(depth, part.cameras), 0.0), inside, atol=1e-4)
    assert pad_to_patches(part.masks, 14) is None
