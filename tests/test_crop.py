"""Windows around the subject keep geometry and lose nothing."""

import pytest
import torch

from ghgs_lit.geometry.crop import subject_windows
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
def test_windows_hold_the_masks_at_a_multiple_of_the_patch(size, seed):
    masks = boxes(2, 3, *size, seed)
    windows = subject_windows(masks, 14)
    assert windows.height % 14 == windows.width % 14 == 0
    assert windows.height < size[0]
    assert windows.width < size[1]
    assert torch.equal(windows.cut(masks).flatten(2).sum(-1), masks.flatten(2).sum(-1))
    assert torch.equal(windows.paste(windows.cut(masks), False), masks)


def test_points_of_a_cut_batch_are_those_of_the_whole():
    masks = boxes(2, 2, 70, 56)
    depths = torch.rand(2, 2, 70, 56) + 1
    images = torch.rand(2, 2, 3, 70, 56)
    whole = Batch(images, masks, cameras(2, 2, 70, 56), depths=depths)
    windows = subject_windows(masks, 7)
    part = windows.cut_batch(whole)
    points = windows.paste(unproject_maps(part.depths, part.cameras), 0.0)
    expected = unproject_maps(depths, whole.cameras)
    assert torch.allclose(points[masks], expected[masks], atol=1e-5)
    pasted = windows.paste(part.images.movedim(2, -1), 0.0)
    assert torch.equal(pasted[masks], images.movedim(2, -1)[masks])


def test_an_empty_mask_and_a_full_one():
    masks = torch.zeros(1, 2, 28, 28, dtype=torch.bool)
    assert subject_windows(masks, 14, margin=2).height == 14
    masks[0, 1] = True
    windows = subject_windows(masks, 14)
    assert (windows.height, windows.width) == (28, 28)
    assert windows.top.eq(0).all()
