"""Options, errors and configurations of the renderer."""

import dataclasses

import pytest
import torch
from omegaconf import OmegaConf

from ghgs_lit.config import compose as project_compose
from ghgs_lit.errors import InputError
from ghgs_lit.rendering import RasterSettings, Renderer, render
from ghgs_lit.types import Cameras, Gaussians
from tests.helpers.splats import camera_ring, cloud


@pytest.mark.parametrize(
    ("kind", "options", "key"),
    [
        (Renderer, {"backend": "cuda"}, "renderer.backend"),
        (Renderer, {"near": 0.0}, "renderer.near"),
        (Renderer, {"near": float("nan")}, "renderer.near"),
        (Renderer, {"background": "white"}, "renderer.background"),
        (Renderer, {"background": [0.0, float("inf"), 0.0]}, "renderer.background"),
        (Renderer, {"alpha_max": 1.0}, r"renderer\.alpha_max"),
        (Renderer, {"alpha_mx": 0.9}, "renderer.alpha_mx: .*did you mean alpha_max"),
        (RasterSettings, {"low_pass": -1.0}, "low_pass"),
        (RasterSettings, {"alpha_max": 1.0}, "alpha_max"),
        (RasterSettings, {"alpha_max": 0.003}, "alpha_max"),
        (RasterSettings, {"antialiased": 1}, "antialiased"),
        (RasterSettings, {"lowpass": 0.3}, "lowpass"),
    ],
)
def test_impossible_options_are_refused_by_name(kind, options, key):
    with pytest.raises(InputError, match=key):
        kind(**options)


@pytest.mark.parametrize("near", [0.0, float("nan"), float("inf")])
def test_an_impossible_near_plane_is_refused(near):
    """It would render nothing, or Gaussians behind the camera."""
    with pytest.raises(InputError, match="near"):
        render(cloud(5), camera_ring(1, 20, 30), "cpu", near=near)


def test_auto_is_the_cpu_backend_for_cpu_tensors():
    """``auto`` selects the CPU backend for CPU tensors."""
    gaussians, views = cloud(20), camera_ring(2, 20, 30)
    assert torch.equal(Renderer()(gaussians, views).image, render(gaussians, views, "cpu").image)


def one_camera(size):
    """A camera at the origin that looks along z."""
    lens = torch.tensor([[20.0, 0, size / 2], [0, 20, size / 2], [0, 0, 1]])
    return Cameras(lens[None, None], torch.eye(4)[None, None], size, size)


def unturned(means, scale, colors, **constants):
    """Opaque spherical Gaussians."""
    count = len(means)
    turns, scales = torch.tensor([[1.0, 0, 0, 0]] * count), torch.full((count, 3), scale)
    return Gaussians(torch.tensor(means), turns, scales, torch.ones(count), colors, (count,), **constants)


@pytest.mark.parametrize("verb", ["train", "evaluate"])
def test_the_release_renders_with_its_own_constants(verb):
    """Regression: the authors cull below 0.2 m and cap alpha at 0.99; a splat 0.1 m from the camera cost
    4 dB."""
    nodes = [
        OmegaConf.to_container(project_compose(verb, overrides).renderer)
        for overrides in ([], ["compat=release"], ["compat=release", "renderer.near=0.05"])
    ]
    renderers = [Renderer(**{k: v for k, v in node.items() if k != "kind"}) for node in nodes]
    assert [renderer.near for renderer in renderers] == [0.01, 0.2, 0.05]
    assert [renderer.alpha_max for renderer in renderers] == [0.999, 0.99, 0.99]
    splats = unturned([[0, 0, 0.1], [0, 0, 1.0]], 0.5, torch.eye(3)[:2])
    near, release, _ = (renderer(splats, one_camera(10)).image[0, 0, :, 5, 5] for renderer in renderers)
    assert near.argmax() == 0
    torch.testing.assert_close(release, torch.tensor([0.0, 0.99, 0.0]), atol=1e-4, rtol=0)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_backgrounds(backend):
    """Every form of background is blended with weight 1 - alpha; a wrong number of channels is rejected."""
    gaussians, views = cloud(20), camera_ring(2, 20, 30)
    black = render(gaussians, views, backend)
    behind = 1 - black.alpha
    color = torch.tensor([0.1, 0.5, 0.9])
    for background in (color, (0.1, 0.5, 0.9), color.expand(1, 2, 3)[..., None, None]):
        image = render(gaussians, views, backend, background=background).image
        torch.testing.assert_close(image, black.image + behind * color[:, None, None])
    torch.testing.assert_close(
        Renderer(backend=backend, background=0.5)(gaussians, views, background=1.0).image,
        black.image + behind,
    )

    # Black is a background like any other.
    shown = Renderer(backend=backend, background=0.5)(gaussians, views, background=0.0).image
    assert torch.equal(shown, black.image)
    with pytest.raises(InputError, match="background"):
        render(gaussians, views, backend, background=(0.0, 1.0))


def test_the_background_is_differentiable():
    """A learned background gets a gradient."""
    background = torch.zeros(3, requires_grad=True)
    rendering = render(cloud(20), camera_ring(1, 20, 30), "cpu", background=background)
    rendering.image.sum().backward()
    torch.testing.assert_close(background.grad, (1 - rendering.alpha).sum().expand(3))


SKEWED = torch.tensor([[20.0, 1, 5], [0, 20, 5], [0, 0, 1]])


@pytest.mark.parametrize(
    ("gaussians", "views", "key"),
    [
        (cloud(20), camera_ring(2, 20, 30)[0], "cameras"),
        (cloud(20, splits=(10, 10)), camera_ring(2, 20, 30), "cameras"),
        (cloud(20, splits=(19,)), camera_ring(2, 20, 30), r"gaussians\.splits"),
        (cloud(20), Cameras(SKEWED[None, None], torch.eye(4)[None, None], 10, 10), "skew"),
    ],
)
def test_inputs_that_do_not_fit_are_refused_by_name(gaussians, views, key):
    with pytest.raises(InputError, match=key):
        render(gaussians, views, "cpu")


def test_gaussians_are_drawn_with_the_constants_that_they_were_made_for():
    """Unless settings override them."""
    views = one_camera(10)
    one = unturned([[0, 0, 1.0]], 0.02, torch.ones(1, 3), low_pass=0.1, antialiased=True)
    sharp, plain = RasterSettings(low_pass=0.1, antialiased=True), RasterSettings()
    assert torch.equal(render(one, views).image, render(one, views, settings=sharp).image)
    assert torch.equal(Renderer()(one, views).image, render(one, views, settings=sharp).image)
    forced = render(one, views, settings=plain).image
    assert not torch.equal(forced, render(one, views).image)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_elements_of_worlds_far_apart_are_drawn_as_near_the_origin(backend):
    """Float64 elements are moved to their cameras: 1000 km away, float32 resolves only 6 cm."""
    splats, views = cloud(20, splits=(12, 8)), camera_ring(2, 20, 30, batch=2)
    expected = render(splats, views, backend)
    away = torch.tensor([[0.0, 0.0, 0.0], [1e6, -4e5, 3e5]]).double()
    element = torch.tensor([0] * 12 + [1] * 8)
    extrinsics = views.extrinsics.double().clone()
    extrinsics[..., :3, 3] -= (extrinsics[..., :3, :3] @ away[:, None, :, None])[..., 0]
    far = dataclasses.replace(splats, means=splats.means.double() + away[element])
    found = render(far, dataclasses.replace(views, extrinsics=extrinsics), backend)
    # float64 rounds to 1e-10 m there, float32 to 1e-7 of the distance to the camera.
    torch.testing.assert_close(found.image.float(), expected.image, atol=1e-4, rtol=0)
    torch.testing.assert_close(found.depth.float(), expected.depth, atol=1e-4, rtol=0)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_the_worlds_unit_changes_no_image(backend):
    """With ``metre`` set, a world in millimetres gives the same image, and 1000 times the depth."""
    splats, views = cloud(20, splits=(12, 8)), camera_ring(2, 20, 30, batch=2)
    expected = render(splats, views, backend, near=2.5)
    units = torch.tensor([1.0, 1000.0])
    lengths = torch.tensor([1.0] * 12 + [1000.0] * 8)[:, None]
    extrinsics = views.extrinsics.clone()
    extrinsics[..., :3, 3] *= units[:, None, None]
    large = dataclasses.replace(
        splats, means=splats.means * lengths, scales=splats.scales * lengths, metre=units
    )
    found = render(large, dataclasses.replace(views, extrinsics=extrinsics), backend, near=2.5)
    torch.testing.assert_close(found.image, expected.image, atol=1e-4, rtol=0)
    unit = units[:, None, None, None, None]
    torch.testing.assert_close(found.depth / unit, expected.depth, atol=1e-4, rtol=0)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize(("near", "drawn"), [(0.5, (0, 1)), (1.0, (0, 1)), (1.5, (1,)), (3.5, ())])
def test_near_is_a_depth_of_centres(backend, near, drawn):
    """Of two splats 1 m and 3 m away, those from ``near`` on, itself included, are rendered."""
    two = unturned([[-0.2, 0, 1.0], [0.6, 0, 3.0]], 0.05, torch.eye(3)[:2])
    found = render(two, one_camera(20), backend, near=near).image[0, 0].flatten(1).sum(1)
    assert (found[:2] > 0.5).tolist() == [0 in drawn, 1 in drawn]
