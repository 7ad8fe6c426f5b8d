"""The kernel of the Gaussian head's activations against plain PyTorch."""

import dataclasses

import pytest
import torch

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.method.heads.attributes import RawGaussians
from ghgs_lit.ops.activation import cpu
from ghgs_lit.types import DepthMaps, Points
from tests.helpers.kernels import plain_pytorch
from tests.helpers.scenes import make_batch, with_soft_rims
from tests.method.heads.test_gaussian import make_head

FIELDS = ("means", "quaternions", "scales", "opacities", "colors")


def scene(b, v, height, width, scale=1.0, color=True):
    """Raw attributes of every pixel of the subject but some, and depths with steps."""
    g = torch.Generator().manual_seed(0)
    batch = with_soft_rims(make_batch(b, v, height, width))
    depth = VisualHull()(batch).near + 0.01 * torch.randn(batch.masks.shape, generator=g)
    valid = batch.masks & (torch.rand(batch.masks.shape, generator=g) > 0.1)
    valid[-1, 0] = False
    image, pixel = valid.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
    n = len(image)
    draw = [scale * torch.randn(n, *size, generator=g) for size in ((3,), (3,), (4,), (), (3,))]
    splits = tuple(valid.flatten(1).sum(1).tolist())
    raw = RawGaussians(torch.zeros(n, 1), *draw[:4], draw[4] if color else None, image, pixel, splits)
    maps = DepthMaps(depth, valid, torch.ones_like(depth))
    nowhere = torch.zeros(0, 3), torch.zeros(0, dtype=torch.bool), torch.zeros(0, dtype=torch.long)
    return raw, batch, Points(unproject_maps(depth, batch.cameras), valid, *nowhere), maps


@torch.no_grad()
def both(head, *inputs):
    found = head.activate(*inputs)
    with plain_pytorch():
        return found, head.activate(*inputs)


@pytest.mark.parametrize("axes", ["world", "surface"])
@pytest.mark.parametrize(("b", "v", "height", "width"), [(2, 3, 42, 84), (1, 4, 56, 56)])
@pytest.mark.parametrize("scale", [1.0, 30.0])
@pytest.mark.parametrize("is_soft", [False, True])
def test_the_kernel_gives_the_gaussians_of_plain_pytorch(axes, b, v, height, width, scale, is_soft):
    raw, batch, points, maps = scene(b, v, height, width, scale, color=is_soft)
    batch = batch if is_soft else dataclasses.replace(batch, alpha=None)
    attributes = {"inward": 0.4, "thickness_start": 0.2}
    limit = None if is_soft and scale == 1 else 0.05
    colors = {"guide": True, "color_limit": 0.5 * is_soft}
    head = make_head(axes=axes, attributes=attributes, offset_limit=limit, **colors)
    found, expected = both(head, raw, batch, points, maps)
    for name in FIELDS:
        mine, own = getattr(found, name), getattr(expected, name)
        # Axes of nearly level pixels are quotients of small differences of depths.
        torch.testing.assert_close(
            mine, own, atol=2e-5, rtol=2e-5, msg=lambda said, name=name: f"{name}: {said}"
        )
    assert found.splits == expected.splits
    assert torch.equal(found.image, expected.image)


def test_the_number_of_threads_changes_no_bit_and_what_is_not_finite_no_other():
    raw, batch, points, maps = scene(2, 4, 56, 56)
    head, threads, results = make_head(axes="surface"), torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            with torch.no_grad():
                results.append(head.activate(raw, batch, points, maps))
    finally:
        torch.set_num_threads(threads)
    broken = raw.scale.clone()
    broken[7] = torch.nan
    with torch.no_grad():
        other = head.activate(dataclasses.replace(raw, scale=broken), batch, points, maps)
    for name in FIELDS:
        one, three, found = (getattr(x, name) for x in (*results, other))
        assert torch.equal(one, three), name
        assert torch.equal(found[8:], one[8:]), name
    assert other.scales[7].isnan().all()


def test_gradients_are_plain_pytorchs(monkeypatch):
    raw, batch, points, maps = scene(1, 3, 42, 42)
    monkeypatch.setattr(cpu, "activate", None)
    raw = dataclasses.replace(raw, scale=raw.scale.requires_grad_())
    make_head(axes="surface").activate(raw, batch, points, maps).scales.sum().backward()
    assert raw.scale.grad.any()
