"""The CPU backend against the reference in float64: images, alphas, depths and all gradients, also for
huge, tiny, zero and broken values, and at thresholds."""

import dataclasses

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ghgs_lit.errors import InputError
from ghgs_lit.rendering import RasterSettings, render
from tests.helpers.splats import (
    FIELDS,
    assert_cpu_matches_reference,
    body,
    camera_ring,
    cloud,
    few,
    relative_error,
    with_gradients,
)

NAN, INF = float("nan"), float("inf")
OTHER = RasterSettings(low_pass=0.05, alpha_max=0.9)
OUTSIDE = [[3.0, 0.1, 0], [-2.5, 0.2, 0.3], [0.2, 2.5, -0.1], [0.1, -4.0, 0.4]]


def long_thin(ratio):
    gaussians = cloud(40)
    long = 0.8 / gaussians.scales.new_tensor([1.0, ratio, ratio])
    return dataclasses.replace(gaussians, scales=long.expand(40, 3))


def of_scale(scale):
    means = [[0, 0, 0.2], [0, 0, 0], [0.1, 0, -0.1]]
    return few(scales=[[0.1] * 3, [scale] * 3, [0.1, scale, 0.1]], means=means)


def equal_depths():
    """Thousands of splats of equal depth, which are rendered in the order of their index."""
    gaussians = few(means=torch.zeros(3000, 3), scales=[[0.05, 0.07, 0.03]], opacities=[0.01])
    return dataclasses.replace(
        gaussians, colors=torch.rand(3000, 3, generator=torch.Generator().manual_seed(3))
    )


def scale_fields(**factors):
    """Gaussians with some of their fields multiplied."""
    gaussians = cloud(50)
    return dataclasses.replace(
        gaussians, **{name: factor * getattr(gaussians, name) for name, factor in factors.items()}
    )


#: Gaussians, number and size of the views, and options of the comparison.
SCENES = {
    **{
        f"{height} x {width}, antialiased={antialiased}": (
            cloud(150, size=0.1), (2, height, width), {"settings": RasterSettings(antialiased=antialiased)}
        )
        for height, width in [(45, 70), (16, 32), (1, 1), (3, 33)]
        for antialiased in (False, True)
    },
    "other constants": (cloud(80, size=0.3), (1, 24, 24), {"settings": OTHER}),
    "one splat in all tiles": (few(scales=[[3.0, 2.0, 4.0]]), (1, 50, 90), {}),
    **{f"{ratio} times as long": (long_thin(ratio), (2, 40, 40), {}) for ratio in (10, 100, 1000, 10000)},
    **{
        f"scale {scale:g}": (of_scale(scale), (1, 20, 20), {"ambiguous_budget": 0.05})
        for scale in (0.0, 1e-12, 1e4, 1e20)
    },
    "opacity above one, cut at the extent": (few(opacities=[50.0], scales=[[0.3] * 3]), (1, 32, 32), {}),
    "opacity one, clamped": (few(opacities=[1.0, 0.5], means=[[0, 0, 0], [0, 0, 1]]), (1, 17, 17), {}),
    "a closed surface of pixel-sized splats": (body(2000, 48), (1, 48, 48), {"background": (0.1, 0.3, 0.6)}),
    "hundreds of opaque layers, where pixels end early": (
        dataclasses.replace(cloud(400, size=2.0), opacities=torch.ones(400)), (1, 24, 24), {}
    ),
    "equal depths": (equal_depths(), (1, 8, 8), {"ambiguous_budget": 0.3}),
    "beyond the clamped Jacobian": (few(means=OUTSIDE, scales=[[1.0, 0.5, 0.7]]), (1, 32, 32), {}),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_images_and_gradients_are_the_references(name):
    gaussians, views, options = SCENES[name]
    rendering = assert_cpu_matches_reference(gaussians, camera_ring(*views), **options)
    assert float(rendering.alpha.detach().max()) > 0.01


@pytest.mark.parametrize(
    "gaussians",
    [
        *(few(opacities=[opacity]) for opacity in (0.0, -1.0, NAN)),
        *(few(means=[[0.0, 0.0, z]]) for z in (-10.0, -3.0, -2.99, -3.0 + 0.0099)),
    ],
)
def test_what_shows_nothing_has_no_gradient(gaussians):
    """Opacities of zero, below zero and NaN; Gaussians behind the camera or nearer than ``near``."""
    gaussians = with_gradients(gaussians)
    rendering = render(gaussians, camera_ring(1, 20, 20), "cpu", background=0.5, near=0.015)
    rendering.image.sum().backward()
    assert (rendering.image == 0.5).all()
    assert not rendering.alpha.any()
    assert not rendering.depth.any()
    assert not any(getattr(gaussians, name).grad.any() for name in FIELDS)


def test_a_clamped_alpha_has_no_gradient_in_opacity():
    gaussians = with_gradients(few(opacities=[1.0], scales=[[10.0] * 3]))
    alpha = render(gaussians, camera_ring(1, 17, 17), "cpu").alpha[0, 0, 0, 8, 8]
    alpha.backward()
    assert float(alpha.detach()) == pytest.approx(0.999, abs=1e-6)
    assert float(gaussians.opacities.grad) == 0


def test_elements_with_different_numbers_of_gaussians():
    """An element's image does not depend on other elements, and an empty one shows the background."""
    gaussians = cloud(100, splits=(0, 70, 1, 29))
    rendering = assert_cpu_matches_reference(gaussians, camera_ring(3, 20, 36, batch=4), background=0.5)
    assert (rendering.alpha[0] == 0).all()
    assert (rendering.image[0] == 0.5).all()
    for element in (1, 3):
        alone = render(gaussians[element], camera_ring(3, 20, 36), "cpu", background=0.5)
        assert torch.equal(alone.image[0], rendering.image[element])


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
    """Random sizes, distances and image sizes equal the reference."""
    gaussians = cloud(count, seed, size)
    views = camera_ring(1, height, width, distance=distance)
    # Behind alpha = 0.999 rounding errors of 1e-7 in the gradient are divided by 1 - alpha = 1e-3.
    assert_cpu_matches_reference(
        gaussians, views, image_budget=5e-5, gradient_budget=2e-3, ambiguous_budget=0.1, near=0.05
    )


@pytest.mark.parametrize(("splits", "views"), [((0, 0), 0), ((0, 0), 2), ((5,), 0), ((), 2)])
def test_without_gaussians_views_or_elements(splits, views):
    """The image is the background, or empty, and gradients are 0."""
    gaussians = with_gradients(cloud(sum(splits), splits=splits))
    cameras = camera_ring(2, 20, 30, batch=2)[: len(splits), :views]
    rendering = render(gaussians, cameras, "cpu", background=0.25)
    assert rendering.image.shape == (len(splits), views, 3, 20, 30)
    assert (rendering.image == 0.25).all()
    assert not rendering.alpha.any()
    rendering.image.sum().backward()
    assert gaussians.means.grad.shape == gaussians.means.shape
    assert not gaussians.means.grad.any()


def test_of_equal_depths_the_first_index_is_in_front():
    two = few(means=torch.zeros(2, 3), opacities=[0.9, 0.9], colors=[[1.0, 0, 0], [0, 1.0, 0]])
    red, green = render(two, camera_ring(1, 20, 20), "cpu").image[0, 0, :2].unbind(0)
    torch.testing.assert_close(green, red * (1 - red))


def test_inputs_of_any_layout_and_dtype():
    """Strided, float64 and bfloat16 inputs are converted, and gradients have their dtype."""
    plain, views = cloud(40), camera_ring(1, 24, 24)
    wanted = render(plain, views, "cpu").image
    strided = dataclasses.replace(
        plain,
        means=plain.means.T.contiguous().T,
        scales=torch.stack((plain.scales, plain.scales), dim=-1)[..., 0],
        opacities=plain.opacities[:, None].expand(40, 2)[:, 1],
    )
    assert not strided.scales.is_contiguous()
    assert torch.equal(render(strided, views, "cpu").image, wanted)
    double = with_gradients(plain, torch.float64)
    rendering = render(double, views, "cpu")
    rendering.image.sum().backward()
    assert double.means.grad.dtype == torch.float64
    assert relative_error(rendering.image, wanted) < 1e-6
    half = render(plain.to(torch.bfloat16), views, "cpu")
    assert half.image.dtype == torch.float32


def test_gradients_of_only_some_inputs():
    """Gradients of some inputs equal those computed for all."""
    gaussians, views = cloud(40), camera_ring(1, 24, 24)
    everything = with_gradients(gaussians)
    render(everything, views, "cpu").image.sum().backward()
    colors = gaussians.colors.clone().requires_grad_()
    render(dataclasses.replace(gaussians, colors=colors), views, "cpu").image.sum().backward()
    assert torch.equal(colors.grad, everything.colors.grad)
    assert gaussians.means.grad is None


@pytest.mark.parametrize("factors", [{"scales": -1}, {"quaternions": 1e-15}, {"quaternions": 1e15}], ids=str)
def test_neither_signs_of_scales_nor_norms_of_quaternions_matter(factors):
    views = camera_ring(1, 24, 24)
    for backend in ("cpu", "reference"):
        found = render(scale_fields(**factors), views, backend).image
        torch.testing.assert_close(found, render(cloud(50), views, backend).image, rtol=0, atol=1e-6)
    assert_cpu_matches_reference(scale_fields(**factors), views)


def test_the_zero_quaternion_is_identity_without_gradient():
    """A zero quaternion is rendered unrotated and gets a gradient of 0, not NaN."""
    views = camera_ring(1, 20, 20)
    zero = with_gradients(few(quaternions=[[0.0] * 4], scales=[[0.1, 0.2, 0.05]]))
    rendering = render(zero, views, "cpu")
    rendering.image.sum().backward()
    assert torch.equal(rendering.image, render(few(scales=[[0.1, 0.2, 0.05]]), views, "cpu").image)
    assert (zero.quaternions.grad == 0).all()
    assert zero.scales.grad.abs().sum() > 0


@pytest.mark.parametrize("far_off", [1e8, 1e30, 3e38, INF])
def test_far_off_screen(far_off):
    """Gaussians at huge distances from the frame give no NaN or infinity."""
    for scale in (0.1, 1e8, 1e20):
        gaussians = few(
            means=[[0, 0, 0], [far_off, 0, 0], [0, -far_off, 0]], scales=[[0.1] * 3, [scale] * 3, [scale] * 3]
        )
        gaussians = with_gradients(gaussians)
        rendering = render(gaussians, camera_ring(1, 40, 40), "cpu")
        rendering.image.sum().backward()
        assert torch.isfinite(rendering.image).all()
        assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in FIELDS)
        if scale < 1:
            assert torch.equal(rendering.image, render(few(), camera_ring(1, 40, 40), "cpu").image)


@pytest.mark.parametrize("field", ["means", "quaternions", "scales", "opacities"])
@pytest.mark.parametrize("value", [NAN, INF])
def test_what_is_not_a_number_reaches_no_other_gaussian(field, value):
    """A Gaussian with NaN or infinity in its geometry affects no other."""
    healthy, views = cloud(30, size=0.2), camera_ring(1, 24, 24)
    broken = dataclasses.replace(healthy, **{field: getattr(healthy, field).clone()})
    getattr(broken, field).view(30, -1)[7, 0] = value
    broken = with_gradients(broken)
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
    """A broken colour affects only the pixels of its splat, and no gradients of others."""
    views = camera_ring(1, 40, 40)
    scene = few(means=[[-0.3, 0, 0], [0.45, 0.3, 0]], scales=[[0.03] * 3])
    scene.colors[1] = value
    scene = with_gradients(scene)
    rendering = render(scene, views, backend)
    touched = render(few(means=[[0.45, 0.3, 0]], scales=[[0.03] * 3]), views, backend).alpha > 0
    assert torch.equal(torch.isfinite(rendering.image[0, 0, 0]), ~touched[0, 0, 0])
    weights = torch.where(touched, 0.0, 1.0)
    torch.where(touched, 0.0, rendering.image * weights).sum().backward()
    for name in ("means", "scales", "opacities", "quaternions"):
        assert torch.isfinite(getattr(scene, name).grad[0]).all()
    assert scene.opacities.grad[0] != 0


def test_thresholds_at_equality():
    """A splat just at the smallest alpha or the smallest transmittance is treated as the definition says."""
    views = camera_ring(1, 16, 16)
    views.intrinsics[..., :2, 2] = 8.5
    just, below = 1 / 255, 1 / 255 * (1 - 1e-5)
    for backend in ("cpu", "reference"):
        # At the splat's centre, which is a pixel's centre, alpha is the opacity itself.
        scenes = [few(opacities=torch.tensor([o], dtype=torch.float64)) for o in (just * (1 + 1e-6), below)]
        shown = [float(render(scene, views, backend).alpha[0, 0, 0, 8, 8]) for scene in scenes]
        assert shown == [pytest.approx(just, rel=1e-5), 0.0]
    # The transmittance behind the second layer is about 1e-4: below that it is left out.
    for second, wanted in ((0.9899, 1 - 1.01e-4), (0.9901, 0.99)):
        layers = few(
            means=[[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]], opacities=[0.99, second, 0.02], scales=[[0.5] * 3]
        )
        for backend in ("cpu", "reference"):
            alpha = render(layers, views, backend).alpha[0, 0, 0, 8, 8]
            assert float(alpha) == pytest.approx(wanted, abs=3e-6)


def test_antialiased_splats_without_area_vanish():
    """With antialiasing, a splat without area is invisible and gives no NaN."""
    gaussians = with_gradients(
        few(scales=[[0.0] * 3, [0.2, 0.0, 0.0], [0.1] * 3], means=[[0, 0, 0], [0, 0, 0.1], [0, 0, 0.2]])
    )
    views, flat = camera_ring(1, 20, 20), RasterSettings(antialiased=True)
    rendering = render(gaussians, views, "cpu", settings=flat)
    alone = render(few(means=[[0, 0, 0.2]]), views, "cpu", settings=flat)
    rendering.image.sum().backward()
    assert torch.equal(rendering.image, alone.image)
    assert all(torch.isfinite(getattr(gaussians, name).grad).all() for name in FIELDS)


def test_more_splats_in_tiles_than_memory_are_refused_at_once():
    """60 000 splats that fill the frame take 5 GB with their gradients; a one-line error comes before any
    allocation."""
    gaussians = cloud(60_000)
    full = dataclasses.replace(gaussians, scales=torch.full_like(gaussians.scales, 1e4))
    full.means.requires_grad_()
    with pytest.raises(InputError, match=r"cpu: expected .* 4 GiB at most .*4.6 GiB: .* 1019 of each"):
        render(full, camera_ring(1, 512, 512), "cpu")
