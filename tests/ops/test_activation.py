"""CPU and GPU kernels of the activations of Gaussians, compared with plain PyTorch in float64."""

import dataclasses

import pytest
import torch

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.method.heads.attributes import RawGaussians
from ghgs_lit.types import DepthMaps, Points, map_tensors
from tests.helpers.kernels import DEVICE, WHERE, kernels
from tests.helpers.scenes import make_batch, with_soft_rims
from tests.method.heads.test_gaussian import make_head

FIELDS = ("means", "quaternions", "scales", "opacities", "colors")


def scene(b, v, height, width, scale=1.0, color=True):
    """Raw attributes of most foreground pixels, and noisy depths."""
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


RAW = ("offset", "scale", "rotation", "opacity", "color")


def to(value, *where):
    """Apply ``Tensor.to(*where)`` to floating-point tensors, and move the others to ``DEVICE``."""
    return map_tensors(value, lambda x: x.to(*where) if x.is_floating_point() else x.to(DEVICE))


def gaussians_and_gradients(head, raw, batch, points, maps, slopes):
    """Attributes, and the gradients of their products with ``slopes`` with respect to raw attributes and
    points."""
    leaves = [getattr(raw, name) for name in RAW] + [points.pixels]
    leaves = [None if x is None else x.detach().clone().requires_grad_() for x in leaves]
    raw = dataclasses.replace(raw, **dict(zip(RAW, leaves, strict=False)))
    points = dataclasses.replace(points, pixels=leaves[-1])
    gaussians = head.activate(raw, batch, points, maps)
    found = [getattr(gaussians, name) for name in FIELDS]
    leaves = [x for x in leaves if x is not None]
    learned = [(x, slope.to(x)) for x, slope in zip(found, slopes, strict=True) if x.requires_grad]
    assert len(learned) == 5 - (raw.color is None)
    outputs, slopes = zip(*learned, strict=True)
    gradients = torch.autograd.grad(outputs, leaves, slopes)
    return [x.detach() for x in found], gradients


def errors(found, exact):
    return [float((x - y).abs().max()) for x, y in zip(found, exact, strict=True)]


def assert_as_exact_as_pytorch(head, *inputs):
    """The error is at most four times that of plain float32, plus four roundings of the largest value."""
    generator = torch.Generator().manual_seed(1)
    n = len(inputs[0].image)
    slopes = [torch.randn(n, *size, generator=generator) for size in ((3,), (4,), (3,), (), (3,))]
    with kernels("cpu") as called, torch.no_grad():
        without = head.activate(*inputs)
    assert called == ["activate"]
    there = [to(x, DEVICE) for x in inputs]
    with kernels("cpu") as called:
        plain, slopes_of_plain = gaussians_and_gradients(head, *there, slopes)
    assert called == []  # CPU kernels have no gradient
    exact, exact_slopes = gaussians_and_gradients(head, *(to(x, torch.float64) for x in there), slopes)
    with kernels() as called:
        found, found_slopes = gaussians_and_gradients(head, *there, slopes)
    assert called == ["activate", "activate_back"]
    of_cpu = [getattr(without, name).to(DEVICE) for name in FIELDS]
    compared = ((of_cpu, plain, exact), (found, plain, exact), (found_slopes, slopes_of_plain, exact_slopes))
    for mine, own, true in compared:
        limits = [4 * error for error in errors(own, true)]
        for error, limit, x in zip(errors(mine, true), limits, true, strict=True):
            assert error <= limit + 4 * torch.finfo(torch.float32).eps * float(x.abs().max())


@pytest.mark.parametrize("axes", ["world", "surface"])
@pytest.mark.parametrize(("b", "v", "height", "width"), [(2, 3, 28, 42), (1, 4, 56, 28)])
@pytest.mark.parametrize(("scale", "limit"), [(1.0, 0.05), (1.0, None), (30.0, 0.05)])
@pytest.mark.parametrize("is_soft", [False, True])
def test_values_and_gradients_are_as_exact_as_plain_pytorchs(
    axes, b, v, height, width, scale, limit, is_soft
):
    """Cases cover saturated attributes, and mattes, offset limits and colour changes on and off."""
    raw, batch, points, maps = scene(b, v, height, width, scale, color=is_soft)
    batch = batch if is_soft else dataclasses.replace(batch, alpha=None)
    options = {"axes": axes, "guide": True, "color_limit": 0.5 * is_soft, "offset_limit": limit}
    head = make_head(attributes={"inward": 0.4, "thickness_start": 0.2}, **options)
    assert_as_exact_as_pytorch(head, raw, batch, points, maps)


def test_rotations_near_none_at_all():
    """The zero quaternion has no direction; the gradient of short quaternions is bounded."""
    raw, *others = scene(1, 3, 28, 28)
    short = torch.tensor([-1.0, 0.0, 0.0, 0.0]).repeat(len(raw.image), 1)
    short[1::3, 1], short[2::3, 2] = 1e-30, -0.03
    assert_as_exact_as_pytorch(
        make_head(axes="surface", guide=True, color_limit=0.1),
        dataclasses.replace(raw, rotation=short),
        *others,
    )


def test_a_pixel_that_is_listed_twice_has_the_sum_of_both_gradients():
    """On a GPU, the rows of a batch are padded by repeating the last one."""
    raw, *others = scene(1, 3, 28, 28)
    rows = torch.cat((torch.arange(len(raw.image)), torch.tensor([len(raw.image) - 1] * 9)))
    values = {name: getattr(raw, name)[rows] for name in ("descriptors", *RAW, "image", "pixel")}
    raw = dataclasses.replace(raw, **values, splits=(len(rows),))
    assert_as_exact_as_pytorch(make_head(axes="surface", guide=True, color_limit=0.1), raw, *others)


def make_strided(x):
    """The same values with a stride of 2 along the last axis."""
    return torch.stack((x, torch.zeros_like(x)), -1)[..., 0]


@pytest.mark.parametrize("kind", WHERE)
@torch.no_grad()
def test_strides_change_nothing_and_what_is_not_finite_no_other(kind):
    raw, batch, points, maps = (map_tensors(x, lambda x: x.to(WHERE[kind])) for x in scene(2, 3, 28, 42))
    head = make_head(axes="surface")
    raw = dataclasses.replace(raw, color=None)
    with kernels(kind):
        expected = head.activate(raw, batch, points, maps)
        found = head.activate(*(map_tensors(x, make_strided) for x in (raw, batch, points, maps)))
        broken = raw.scale.clone()
        broken[7] = torch.nan
        other = head.activate(dataclasses.replace(raw, scale=broken), batch, points, maps)
    for name in FIELDS:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
        assert torch.equal(getattr(other, name)[8:], getattr(expected, name)[8:]), name
    assert other.scales[7].isnan().all()


def test_no_gaussian_has_no_gradient():
    raw, batch, points, maps = scene(1, 3, 28, 28)
    nothing = [getattr(raw, name)[:0].requires_grad_() for name in RAW]
    raw = RawGaussians(raw.descriptors[:0], *nothing, raw.image[:0], raw.pixel[:0], (0,))
    points = dataclasses.replace(points, pixels=points.pixels.requires_grad_())
    with kernels() as called:
        gaussians = make_head(guide=True, color_limit=0.1).activate(
            *(to(x, DEVICE) for x in (raw, batch, points, maps))
        )
        sum(getattr(gaussians, name).sum() for name in FIELDS).backward()
    assert called == ["activate", "activate_back"]
    assert len(gaussians) == 0
    assert not points.pixels.grad.any()


def test_what_the_kernels_do_not_know_is_plain_pytorch():
    """Float64, gradients of input views, and the published attributes have no kernel."""
    inputs = [to(x, DEVICE) for x in scene(1, 2, 28, 28)]
    wide = [to(x, torch.float64) for x in inputs]
    images = inputs[1].images.clone().requires_grad_()
    learned = [inputs[0], dataclasses.replace(inputs[1], images=images, alpha=None), *inputs[2:]]
    with kernels() as called:
        make_head().activate(*wide)
        make_head().activate(*learned).colors.sum().backward()
        make_head(parameterization="release").activate(*inputs)
    assert called == []
    assert images.grad.any()


def test_autocast_rounds_nothing():
    inputs = [to(x, DEVICE) for x in scene(1, 2, 28, 28)]
    with kernels(), torch.no_grad():
        expected = make_head(axes="surface").activate(*inputs)
        with torch.autocast(DEVICE.type, torch.bfloat16):
            found = make_head(axes="surface").activate(*inputs)
    for name in FIELDS:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
