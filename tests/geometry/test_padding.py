"""Padding keeps geometry, and cropping undoes it."""

import pytest
import torch

from ghgs_lit.geometry.padding import pad_to_patches
from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.types import Batch, Cameras, Gaussians


def cameras(b, v, height, width):
    intrinsics = torch.tensor([[90.0, 0, width / 2], [0, 80.0, height / 2 + 3], [0, 0, 1]])
    return Cameras(intrinsics.expand(b, v, 3, 3), torch.eye(4).expand(b, v, 4, 4), height, width)


def boxes(b, v, height, width, seed=0):
    """Random rectangles as masks, some of which touch the border."""
    generator = torch.Generator().manual_seed(seed)
    masks = torch.zeros(b, v, height, width, dtype=torch.bool)
    for index in range(b * v):
        top, left = (int(torch.randint(n - 12, (), generator=generator)) for n in (height, width))
        masks.flatten(0, 1)[index, top : top + 20, left : left + 12] = True
    return masks


@pytest.mark.parametrize(
    ("size", "top", "left", "padded"),
    [((512, 512), -3, -3, (518, 518)), ((360, 640), -2, -2, (364, 644)), ((41, 27), 0, 0, (42, 28))],
)
def test_padding_is_centred_and_undone(size, top, left, padded):
    """512 gets 3 pixels on each side as in the authors' release; an odd pixel goes to the bottom and
    right."""
    alpha = torch.rand(1, 2, *size)
    batch = Batch(torch.rand(1, 2, 3, *size), boxes(1, 2, *size), cameras(1, 2, *size), alpha=alpha)
    padding = pad_to_patches(batch.masks, 14)
    assert (padding.top, padding.left) == (top, left)
    part = padding.pad_batch(batch)
    assert tuple(part.images.shape[3:]) == tuple(part.masks.shape[2:]) == padded
    assert (part.cameras.height, part.cameras.width) == padded
    assert part.images.sum() == pytest.approx(batch.images.sum().item())
    assert torch.equal(padding.cut(part.masks), batch.masks)
    assert torch.equal(padding.cut(part.alpha), alpha)
    assert part.alpha.sum() == pytest.approx(alpha.sum().item())
    shift = part.cameras.intrinsics - batch.cameras.intrinsics
    assert shift[0, 0, :2, 2].tolist() == [-left, -top]
    depth = torch.rand(1, 2, *padded) + 1
    inside = unproject_maps(padding.cut(depth), batch.cameras)
    assert torch.allclose(padding.cut(unproject_maps(depth, part.cameras)), inside, atol=1e-4)
    assert pad_to_patches(part.masks, 14) is None


@pytest.mark.parametrize("size", [(41, 27), (50, 60)])
def test_gaussians_are_named_by_pixels_of_the_photograph(size):
    """Pixel indices in the padded image become those in the unpadded one."""
    padding = pad_to_patches(torch.zeros(1, 1, *size, dtype=torch.bool), 14)
    rows, columns = torch.meshgrid(torch.arange(size[0]), torch.arange(size[1]), indexing="ij")
    inside = ((rows - padding.top) * padding.width + columns - padding.left).flatten()
    n = len(inside)
    gaussians = Gaussians(
        torch.zeros(n, 3), torch.zeros(n, 4), torch.zeros(n, 3), torch.zeros(n), torch.zeros(n, 3), (n,),
        torch.zeros(n, dtype=torch.long), inside,
    )  # fmt: skip
    assert torch.equal(padding._cut_gaussians(gaussians).pixel, torch.arange(n))
