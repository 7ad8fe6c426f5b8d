"""CPU and GPU kernels of the activations of Gaussians, compared with plain PyTorch in float64."""

import dataclasses

import pytest
import torch

from ghgs_lit.geometry.projection import unproject_maps
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.method.bounds import VisualHull
from ghgs_lit.method.heads.attributes import FootprintAttributes, RawGaussians
from ghgs_lit.method.heads.depth import BOUNDED, bounded_depth, inverse_linear
from ghgs_lit.ops.activation import (
    bounded_sigmoid,
    bounded_tanh,
    confidence_of,
    footprint_attributes,
    surface_axes,
)
from ghgs_lit.types import Cameras, DepthMaps, Points, map_tensors
from tests.helpers.kernels import DEVICE, WHERE, kernels
from tests.helpers.scenes import CENTER, RADII, ellipsoid, make_batch, ring, with_soft_rims
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


FAR_OUT = (-1e4, -90.0, -17.0, 17.0, 90.0, 1e4)


@pytest.mark.parametrize(("ours", "plain"), [(bounded_sigmoid, torch.sigmoid), (bounded_tanh, torch.tanh)])
def test_inside_the_limit_it_is_the_plain_function(ours, plain):
    x = torch.linspace(-4.9, 4.9, 41, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(ours(x), plain(x))
    assert torch.autograd.gradcheck(ours, (x,))


@pytest.mark.parametrize("ours", [bounded_sigmoid, bounded_tanh])
@pytest.mark.parametrize("raw", FAR_OUT)
def test_a_gradient_leads_back_from_beyond_the_limit(ours, raw):
    """A plain sigmoid has a gradient of 0 from 17 on: one large step ended the training of a head."""
    for sign in (-1, 1):
        x = torch.tensor(raw, requires_grad=True)
        (gradient,) = torch.autograd.grad(sign * ours(x), x)
        leads_back = sign * raw > 0  # descent then moves towards 0
        assert (gradient * sign > 1e-5) if leads_back else (gradient == 0)


@pytest.mark.parametrize("name", list(BOUNDED))
@pytest.mark.parametrize("raw", [-90.0, 90.0])
def test_a_saturated_depth_recovers(name, raw):
    """Adam recovers a raw value after a step with an adversarial learning rate."""
    near, far = torch.tensor(1.5), torch.tensor(2.5)
    x = torch.tensor(raw, requires_grad=True)
    optimizer = torch.optim.Adam([x], lr=1.0, betas=(0.5, 0.9))
    for _ in range(150):
        optimizer.zero_grad()
        (bounded_depth(x, near, far, name) - 2.0).square().backward()
        optimizer.step()
    assert x.abs() < 10


def attributes(*raws, limit=0.05):
    """Attributes of raw values and footprints, with the constants of the default options."""
    return footprint_attributes(*raws, FootprintAttributes().constants(limit, 0.0))


def test_offsets_go_as_far_as_their_limit():
    """Without a limit, as published, offsets are linear in the raw value: 5 cm for a raw value of 1."""
    raws = [torch.full(shape, 40.0) for shape in ((1, 3), (1, 3), (1, 4), (1,), (1,))]
    for limit, expected in ((0.05, 0.05), (0.2, 0.2), (None, 2.0)):
        offset = attributes(*raws, limit=limit)[0]
        torch.testing.assert_close(offset, torch.full((1, 3), expected), rtol=0.03, atol=0)


@pytest.mark.parametrize("raw", FAR_OUT)
def test_saturated_attributes_keep_a_gradient(raw):
    """Offsets had no gradient from 10 on, scales and opacities none from 20 on."""
    raws = [torch.full(shape, raw, requires_grad=True) for shape in ((1, 3), (1, 3), (1, 4), (1,))]
    values = attributes(*raws, torch.full((1,), 0.004))
    towards_zero = 1.0 if raw > 0 else -1.0
    for name, x, value in zip(("offset", "scale", "rotation", "opacity"), raws, values, strict=True):
        assert value.isfinite().all(), name
        if name != "rotation":
            (gradient,) = torch.autograd.grad(towards_zero * value.sum(), x)
            assert (gradient * towards_zero > 0).all(), name


def test_the_rotation_near_minus_identity_has_a_bounded_gradient():
    """Raw values near (-1, 0, 0, 0) give the zero quaternion q, near which the gradient grows as
    1 / |q|."""
    rotation = torch.tensor([[-1.0, 1e-9, 0.0, 0.0]], requires_grad=True)
    zeros = torch.zeros(1, 3)
    quaternions = attributes(zeros, zeros, rotation, torch.zeros(1), torch.ones(1))[2]
    (gradient,) = torch.autograd.grad(quaternions[0, 2], rotation)
    assert gradient.abs().max() <= 10.0 + 1e-4


def test_the_release_s_depth_has_a_finite_gradient_at_its_pole():
    """At -1e-8 the depth is infinite and is replaced; replacing only the result left a gradient of NaN."""
    x = torch.tensor([-1e-8, 0.1], requires_grad=True)
    depth = inverse_linear(x)
    assert depth[0].isinf()
    torch.where(depth.isfinite(), depth, 1.0).sum().backward()
    assert x.grad[0] == 0
    assert x.grad[1] == pytest.approx(-100, rel=1e-4)


def test_a_confidence_of_any_raw_value_is_finite():
    """Published heads use an exponential, which overflows from 89 on."""
    assert confidence_of(torch.tensor([-1e4, 0.0, 100.0, 1e4])).isfinite().all()


def axes_of(depth, valid, cameras):
    """Matrices [N, 3, 3] of the surface axes of all valid pixels."""
    image, pixel = valid.flatten(0, 1).flatten(1).nonzero(as_tuple=True)
    return quaternion_to_matrix(surface_axes(DepthMaps(depth, valid, depth), cameras, image, pixel))


def camera_axes(batch):
    """Right, down and forward [N, 3, 3] of each pixel's camera, as columns."""
    own = batch.masks.flatten(0, 1).flatten(1).sum(1)
    return batch.cameras.extrinsics[..., :3, :3].flatten(0, 1).mT.repeat_interleave(own, 0)


def test_the_third_axis_is_the_inward_normal_of_an_ellipsoid():
    """Normals match the gradient of the surface's equation; the axes are the camera axes rotated by the
    least angle."""
    cameras = ring(2, 3, 140, 112)
    masks, depths = ellipsoid(cameras)
    batch = dataclasses.replace(make_batch(2, 3, 140, 112), masks=masks, depths=depths)
    found = axes_of(depths, masks, cameras)
    points = unproject_maps(depths, cameras)[masks]
    normal = torch.nn.functional.normalize((CENTER - points) / RADII.square(), dim=-1)
    cosine = (found[:, :, 2] * normal).sum(-1)
    assert cosine.quantile(0.05) > 0.99  # at the rim, finite differences of a curved surface
    assert cosine.min() > 0.7
    torch.testing.assert_close(found.det(), torch.ones(len(found)))
    camera = camera_axes(batch)
    # The least rotation turns about an axis in the image's plane.
    turned = found @ camera.mT
    angle = ((turned.diagonal(dim1=1, dim2=2).sum(-1) - 1) / 2).clamp(-1, 1).acos()
    between = (found[:, :, 2] * camera[:, :, 2]).sum(-1).clamp(-1, 1).acos()
    torch.testing.assert_close(angle, between, atol=2e-3, rtol=0)


def make_plane(slope_x, slope_y, dtype=torch.float64):
    """Depths of the plane z = 2 + a x + b y in front of a camera at the origin that looks along z."""
    size, fx, fy, skew = 20, 30.0, 36.0, 3.0
    lens = torch.tensor([[fx, skew, size / 2 + 1], [0, fy, size / 2 - 2], [0, 0, 1]], dtype=dtype)
    centers = torch.arange(size, dtype=dtype) + 0.5
    v, u = torch.meshgrid(centers, centers, indexing="ij")
    y = (v - lens[1, 2]) / fy
    x = (u - lens[0, 2] - skew * y) / fx
    depth = 2 / (1 - slope_x * x - slope_y * y)
    cameras = Cameras(lens[None, None], torch.eye(4, dtype=dtype)[None, None], size, size)
    return depth[None, None], cameras


@pytest.mark.parametrize(("a", "b"), [(0.0, 0.0), (1.5, 0.0), (-0.4, 1.0)])
def test_planes_are_exact_up_to_their_border(a, b):
    """One-sided differences at the border of the image and of the mask are also exact on a plane."""
    depth, cameras = make_plane(a, b)
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[..., 7:9, 3:5] = False
    depth[~valid] += 0.01  # near the plane, but in the background
    normal = axes_of(depth, valid, cameras)[..., 2]
    expected = torch.nn.functional.normalize(torch.tensor([-a, -b, 1.0], dtype=depth.dtype), dim=0)
    torch.testing.assert_close(normal, expected.expand_as(normal))


def test_surfaces_do_not_mix():
    """A depth step of a metre and pixels outside the mask do not affect the normal."""
    depth, cameras = make_plane(0.0, 0.0)
    depth[..., 10:] += 1.0
    depth[..., :3] = 77.0
    valid = torch.ones_like(depth, dtype=torch.bool)
    valid[..., :3] = False
    axes = axes_of(depth, valid, cameras)
    torch.testing.assert_close(axes, torch.eye(3, dtype=axes.dtype).expand_as(axes))


def test_lonely_pixels_have_the_axes_of_their_camera():
    """Isolated pixels, also in corners of the image."""
    batch = make_batch(1, 3)
    valid = torch.zeros_like(batch.masks)
    valid[..., ::55, ::55] = True
    valid[..., 27, 29] = True
    found = axes_of(torch.full_like(batch.depths, 2.0), valid, batch.cameras)
    torch.testing.assert_close(found, camera_axes(dataclasses.replace(batch, masks=valid)))


def test_axes_turn_with_the_world_and_do_not_depend_on_batch_mates():
    """The same input views in a world with other axes and origin, and as a single batch element."""
    batch = make_batch(2, 3)
    found = axes_of(batch.depths, batch.masks, batch.cameras)
    turn = quaternion_to_matrix(torch.tensor([0.3, -0.5, 0.7, 0.2]))
    world = torch.eye(4)
    world[:3, :3], world[:3, 3] = turn, torch.tensor([3.0, -20.0, 9.0])
    moved = dataclasses.replace(batch.cameras, extrinsics=batch.cameras.extrinsics @ world.inverse())
    turned = axes_of(batch.depths, batch.masks, moved)
    torch.testing.assert_close(turned, turn @ found, atol=1e-5, rtol=0)
    alone = axes_of(batch.depths[1:], batch.masks[1:], batch.cameras[1:])
    assert torch.equal(alone, found[-len(alone) :])
