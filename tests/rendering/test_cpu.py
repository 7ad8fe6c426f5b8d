"""The CPU backend against the reference in float64: images, alphas, depths and every gradient."""

import dataclasses

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ghgs_lit.rendering import RasterSettings, render
from tests.helpers.splats import FIELDS, body, cameras, cloud, compare, error, leaves, one

NAN, INF = float("nan"), float("inf")


@pytest.fixture(autouse=True)
def _one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize(("height", "width"), [(45, 70), (16, 32), (1, 1), (3, 33)])
def test_random_scenes(height, width, antialiased):
    compare(cloud(150, size=0.1), cameras(2, height, width), RasterSettings(antialiased=antialiased))


def test_a_body_of_pixel_sized_splats():
    rendering = compare(body(2000, 48), cameras(1, 48, 48), background=(0.1, 0.3, 0.6))
    assert 0.15 < float((rendering.alpha > 0.5).float().mean()) < 0.3


def test_elements_with_different_numbers_of_gaussians():
    gaussians = cloud(100, splits=(0, 70, 1, 29))
    rendering = compare(gaussians, cameras(3, 20, 36, batch=4), background=0.5)
    assert (rendering.alpha[0] == 0).all()
    assert (rendering.image[0] == 0.5).all()
    for element in (1, 3):
        alone = render(gaussians[element], cameras(3, 20, 36), "cpu", background=0.5)
        assert torch.equal(alone.image[0], rendering.image[element])


@pytest.mark.parametrize("channels", [1, 2, 8, 9, 20])
def test_any_number_of_channels(channels):
    compare(cloud(60, channels=channels, size=0.2), cameras(1, 20, 20))


def test_other_constants():
    other = RasterSettings(
        low_pass=0.05, alpha_max=0.9, alpha_min=0.02, stop=0.01, extent=2.0, frustum_margin=0.1
    )
    compare(cloud(80, size=0.3), cameras(1, 24, 24), other)


@settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(1, 60),
    size=st.floats(1e-4, 3.0),
    distance=st.floats(0.3, 30.0),
    height=st.integers(1, 40),
    width=st.integers(1, 40),
)
def test_scenes_of_any_kind(seed, count, size, distance, height, width):
    gaussians = cloud(count, seed, size)
    views = cameras(1, height, width, distance=distance)
    # Behind alpha = 0.999 the gradient's rounding is divided by 1 - alpha: a thousand times 1e-7 and more.
    compare(gaussians, views, image_budget=5e-5, gradient_budget=2e-3, ambiguous_budget=0.1, near=0.05)


@pytest.mark.parametrize("ratio", [10, 100, 1000, 10000])
def test_long_thin_splats(ratio):
    gaussians = cloud(40)
    long = 1.0 / gaussians.scales.new_tensor([1.0, ratio, ratio])
    compare(dataclasses.replace(gaussians, scales=long.expand(40, 3) * 0.8), cameras(2, 40, 40))


@pytest.mark.parametrize("scale", [0.0, 1e-12, 1e4, 1e20])
def test_scales_of_any_size(scale):
    scales, means = [[0.1] * 3, [scale] * 3, [0.1, scale, 0.1]], [[0, 0, 0.2], [0, 0, 0], [0.1, 0, -0.1]]
    compare(one(scales=scales, means=means), cameras(1, 20, 20), ambiguous_budget=0.05)


def test_negative_scales_mean_their_size():
    gaussians, views = cloud(50), cameras(1, 24, 24)
    negative = dataclasses.replace(gaussians, scales=-gaussians.scales)
    for backend in ("cpu", "reference"):
        torch.testing.assert_close(
            render(negative, views, backend).image, render(gaussians, views, backend).image, rtol=0, atol=1e-6
        )
    compare(negative, views)


@pytest.mark.parametrize("norm", [1e-15, 1e15])
def test_quaternions_of_any_norm(norm):
    gaussians, views = cloud(50), cameras(1, 24, 24)
    scaled = dataclasses.replace(gaussians, quaternions=gaussians.quaternions * norm)
    assert error(render(scaled, views, "cpu").image, render(gaussians, views, "cpu").image) < 1e-6
    compare(scaled, views)


def test_the_zero_quaternion_is_identity_without_gradient():
    views = cameras(1, 20, 20)
    zero = leaves(one(quaternions=[[0.0] * 4], scales=[[0.1, 0.2, 0.05]]))
    rendering = render(zero, views, "cpu")
    rendering.image.sum().backward()
    assert torch.equal(rendering.image, render(one(scales=[[0.1, 0.2, 0.05]]), views, "cpu").image)
    assert (zero.quaternions.grad == 0).all()
    assert zero.scales.grad.abs().sum() > 0


@pytest.mark.parametrize("opacity", [0.0, -1.0, NAN])
def test_opacities_that_show_nothing(opacity):
    gaussians = leaves(one(opacities=[opacity]))
    rendering = render(gaussians, cameras(1, 20, 20), "cpu", background=0.5)
    rendering.image.sum().backward()
    assert (rendering.image == 0.5).all()
    assert (rendering.alpha == 0).all()
    assert (rendering.depth == 0).all()
    assert all((getattr(gaussians, name).grad == 0).all() for name in FIELDS)


def test_opacity_one_is_clamped_and_without_gradient_there():
    views = cameras(1, 17, 17)
    gaussians = leaves(one(opacities=[1.0], scales=[[10.0] * 3]))
    rendering = render(gaussians, views, "cpu")
    rendering.alpha[0, 0, 0, 8, 8].backward()
    assert float(rendering.alpha.detach()[0, 0, 0, 8, 8]) == pytest.approx(0.999, abs=1e-6)
    assert float(gaussians.opacities.grad) == 0
    compare(one(opacities=[1.0, 0.5], means=[[0, 0, 0], [0, 0, 1]]), views)


def test_opacity_above_one_is_cut_at_the_extent():
    compare(one(opacities=[50.0], scales=[[0.3] * 3]), cameras(1, 32, 32))


@pytest.mark.parametrize("z", [-10.0, -3.0, -2.99, -3.0 + 0.0099])
def test_nothing_nearer_than_near_is_seen(z):
    gaussians = leaves(one(means=[[0.0, 0.0, z]]))
    rendering = render(gaussians, cameras(1, 20, 20), "cpu", near=0.015)
    rendering.image.sum().backward()
    assert (rendering.alpha == 0).all()
    assert all((getattr(gaussians, name).grad == 0).all() for name in FIELDS)


def test_exactly_near_and_exactly_far_are_seen():
    views = cameras(1, 20, 20, distance=2.0)
    for options in ({"near": 2.0}, {"far": 2.0}):
        assert float(compare(one(), views, **options).alpha.detach().max()) > 0.5
    assert float(render(one(), views, "cpu", near=2.0001).alpha.max()) == 0
    assert float(render(one(), views, "cpu", far=1.9999).alpha.max()) == 0


@pytest.mark.parametrize("scale", [0.1, 1e8, 1e20])
@pytest.mark.parametrize("far_off", [1e8, 1e30, 3e38, INF])
def test_far_off_screen(far_off, scale):
    gaussians = one(
        means=[[0, 0, 0], [far_off, 0, 0], [0, -far_off, 0]], scales=[[0.1] * 3, [scale] * 3, [scale] * 3]
    )
    gaussians = leaves(gaussians)
    rendering = render(gaussians, cameras(1, 40, 40), "cpu")
    rendering.image.sum().backward()
    assert torch.isfinite(rendering.image).all()
    assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in FIELDS)
    if scale < 1:
        assert torch.equal(rendering.image, render(one(), cameras(1, 40, 40), "cpu").image)


def test_beyond_the_limit_of_the_jacobian():
    """Wide splats outside the frame reach into it; their Jacobian is held and its gradient with it."""
    gaussians = one(
        means=[[3.0, 0.1, 0], [-2.5, 0.2, 0.3], [0.2, 2.5, -0.1], [0.1, -4.0, 0.4]], scales=[[1.0, 0.5, 0.7]]
    )
    assert float(compare(gaussians, cameras(1, 32, 32)).alpha.detach().max()) > 0.1


@pytest.mark.parametrize("field", ["means", "quaternions", "scales", "opacities"])
@pytest.mark.parametrize("value", [NAN, INF])
def test_what_is_not_a_number_reaches_no_other_gaussian(field, value):
    healthy, views = cloud(30, size=0.2), cameras(1, 24, 24)
    broken = dataclasses.replace(healthy, **{field: getattr(healthy, field).clone()})
    getattr(broken, field).view(30, -1)[7, 0] = value
    broken = leaves(broken)
    rendering = render(broken, views, "cpu")
    rendering.image.sum().backward()
    assert torch.isfinite(rendering.image).all()
    others = torch.arange(30) != 7
    assert all(torch.isfinite(getattr(broken, name).grad[others]).all() for name in FIELDS)
    if not (field == "opacities" and value == INF):
        without = render(healthy.select(others, (29,)), views, "cpu")
        assert torch.equal(rendering.image, without.image)


@pytest.mark.parametrize("value", [NAN, INF])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_colour_that_is_not_finite_stays_in_its_pixels(backend, value):
    views = cameras(1, 40, 40)
    scene = one(means=[[-0.3, 0, 0], [0.45, 0.3, 0]], scales=[[0.03] * 3])
    scene.colors[1] = value
    scene = leaves(scene)
    rendering = render(scene, views, backend)
    touched = render(one(means=[[0.45, 0.3, 0]], scales=[[0.03] * 3]), views, backend).alpha > 0
    assert torch.equal(torch.isfinite(rendering.image[0, 0, 0]), ~touched[0, 0, 0])
    weights = torch.where(touched, 0.0, 1.0)
    torch.where(touched, 0.0, rendering.image * weights).sum().backward()
    for name in ("means", "scales", "opacities", "quaternions"):
        assert torch.isfinite(getattr(scene, name).grad[0]).all()
    assert scene.opacities.grad[0] != 0


@pytest.mark.parametrize("views", [0, 2])
def test_no_gaussians(views):
    gaussians = leaves(cloud(0, splits=(0, 0)))
    rendering = render(gaussians, cameras(max(views, 1), 20, 30, batch=2)[:, :views], "cpu", background=0.25)
    assert rendering.image.shape == (2, views, 3, 20, 30)
    assert (rendering.image == 0.25).all()
    assert (rendering.alpha == 0).all()
    rendering.image.sum().backward()
    assert gaussians.means.grad.shape == (0, 3)


def test_no_cameras_and_no_elements():
    gaussians = leaves(cloud(5))
    rendering = render(gaussians, cameras(2, 20, 30)[:, :0], "cpu")
    rendering.image.sum().backward()
    assert rendering.image.shape == (1, 0, 3, 20, 30)
    assert (gaussians.means.grad == 0).all()
    empty = render(cloud(0, splits=()), cameras(2, 20, 30)[:0], "cpu")
    assert empty.image.shape == (0, 2, 3, 20, 30)


def test_one_splat_over_the_whole_image():
    compare(one(scales=[[3.0, 2.0, 4.0]]), cameras(1, 50, 90))


def test_thousands_of_equal_depths_keep_their_order():
    gaussians = one(means=torch.zeros(3000, 3), scales=[[0.05, 0.07, 0.03]], opacities=[0.01])
    colors = torch.rand(3000, 3, generator=torch.Generator().manual_seed(3))
    compare(dataclasses.replace(gaussians, colors=colors), cameras(1, 8, 8), ambiguous_budget=0.3)
    two = one(means=torch.zeros(2, 3), opacities=[0.9, 0.9], colors=[[1.0, 0, 0], [0, 1.0, 0]])
    red, green = render(two, cameras(1, 20, 20), "cpu").image[0, 0, :2].unbind(0)
    torch.testing.assert_close(green, red * (1 - red))


def test_hundreds_of_opaque_layers():
    gaussians = cloud(400, size=2.0)
    compare(dataclasses.replace(gaussians, opacities=torch.full((400,), 1.0)), cameras(1, 24, 24))


def test_thresholds_at_equality():
    """A splat whose centre is a pixel's centre: alpha is exactly its opacity."""
    views = cameras(1, 16, 16)
    views.intrinsics[..., :2, 2] = 8.5
    just, below = 1 / 255, 1 / 255 * (1 - 1e-5)
    for backend in ("cpu", "reference"):
        shown = [
            float(
                render(one(opacities=torch.tensor([o], dtype=torch.float64)), views, backend).alpha[
                    0, 0, 0, 8, 8
                ]
            )
            for o in (just * (1 + 1e-6), below)
        ]
        assert shown == [pytest.approx(just, rel=1e-5), 0.0]
    # T behind the second is 1/16: where that is too little, it is left out, and the third with it.
    layers = one(
        means=[[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]], opacities=[0.75, 0.75, 0.01], scales=[[0.5] * 3]
    )
    # Exactly as much as asked is too little, too.
    for stop, wanted in ((1 / 16 * (1 + 1e-6), 0.75), (1 / 16, 0.75), (1 / 16 * (1 - 1e-6), 15 / 16)):
        for backend in ("cpu", "reference"):
            alpha = render(layers, views, backend, settings=RasterSettings(stop=stop)).alpha[0, 0, 0, 8, 8]
            assert float(alpha) == pytest.approx(wanted, abs=1e-6)


def test_antialiased_splats_without_area_vanish():
    gaussians = leaves(
        one(scales=[[0.0] * 3, [0.2, 0.0, 0.0], [0.1] * 3], means=[[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]])
    )
    views, flat = cameras(1, 20, 20), RasterSettings(antialiased=True)
    rendering = render(gaussians, views, "cpu", settings=flat)
    alone = render(one(means=[[0, 0, 0.2]]), views, "cpu", settings=flat)
    rendering.image.sum().backward()
    assert torch.equal(rendering.image, alone.image)
    assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in FIELDS)


@pytest.mark.parametrize(
    "region", [(5, 9, 20, 30), (0, 0, 45, 70), (16, 16, 16, 16), (44, 3, 1, 2), (4, 4, 0, 9)]
)
def test_a_region_is_the_same_image_cut_out(region):
    gaussians, views = cloud(150, size=0.1), cameras(2, 45, 70)
    compare(gaussians, views, region=region, background=(0.1, 0.2, 0.7))
    top, left, height, width = region
    whole, part = (render(gaussians, views, "cpu", region=box) for box in (None, region))
    box = (..., slice(top, top + height), slice(left, left + width))
    for name in ("image", "alpha", "depth"):
        wanted = torch.zeros_like(getattr(whole, name))
        wanted[box] = getattr(whole, name)[box]
        assert torch.equal(getattr(part, name), wanted)


def test_a_region_for_each_view():
    gaussians, views = cloud(100, size=0.1, splits=(60, 40)), cameras(2, 30, 40, batch=2)
    boxes = torch.tensor([[[0, 0, 10, 10], [5, 5, 20, 30]], [[1, 2, 0, 0], [0, 0, 30, 40]]])
    compare(gaussians, views, region=boxes)
    alone = render(gaussians[1], views[1:, 1:], "cpu")
    assert torch.equal(render(gaussians, views, "cpu", region=boxes).image[1, 1], alone.image[0, 0])


def test_inputs_of_any_layout_and_dtype():
    plain, views = cloud(40), cameras(1, 24, 24)
    wanted = render(plain, views, "cpu").image
    strided = dataclasses.replace(
        plain,
        means=plain.means.T.contiguous().T,
        scales=torch.stack((plain.scales, plain.scales), dim=-1)[..., 0],
        opacities=plain.opacities[:, None].expand(40, 2)[:, 1],
    )
    assert not strided.scales.is_contiguous()
    assert torch.equal(render(strided, views, "cpu").image, wanted)
    double = leaves(plain, torch.float64)
    rendering = render(double, views, "cpu")
    rendering.image.sum().backward()
    assert double.means.grad.dtype == torch.float64
    assert error(rendering.image, wanted) < 1e-6
    half = render(plain.to(torch.bfloat16), views, "cpu")
    assert half.image.dtype == torch.float32


def test_gradients_of_only_some_inputs():
    gaussians, views = cloud(40), cameras(1, 24, 24)
    everything = leaves(gaussians)
    render(everything, views, "cpu").image.sum().backward()
    colors = gaussians.colors.clone().requires_grad_()
    render(dataclasses.replace(gaussians, colors=colors), views, "cpu").image.sum().backward()
    assert torch.equal(colors.grad, everything.colors.grad)
    assert gaussians.means.grad is None
