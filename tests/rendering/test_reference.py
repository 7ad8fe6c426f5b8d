"""The reference renderer: its gradients, its projection, and its image against a loop over pixels."""

import math

import pytest
import torch

from ghgs_lit.geometry.projection import project
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.rendering import RasterSettings, reference, render
from ghgs_lit.types import Gaussians
from tests.helpers.splats import FIELDS, camera_ring, cloud


@pytest.mark.parametrize("antialiased", [False, True])
def test_gradients_of_the_reference_are_those_of_its_values(monkeypatch, antialiased):
    """Gradients match finite differences where no threshold causes steps."""
    for name, value in {"ALPHA_MIN": 1e-12, "STOP": 0.0, "EXTENT": 30.0}.items():
        monkeypatch.setattr(reference, name, value)
    settings = RasterSettings(antialiased=antialiased)
    gaussians = cloud(4, size=0.3, splits=(3, 1))
    views = camera_ring(1, 3, 4, batch=2).to(torch.float64)

    def outputs(*fields):
        scene = Gaussians(*fields, splits=(3, 1))
        rendering = render(scene, views, "reference", background=(0.2, 0.5, 0.1), settings=settings)
        return rendering.image, rendering.alpha, rendering.depth

    inputs = tuple(getattr(gaussians, name).double().requires_grad_() for name in FIELDS)
    assert torch.autograd.gradcheck(outputs, inputs, atol=1e-7)


def test_splats_are_composited_front_to_back_with_every_threshold():
    """The reference equals a loop over splats and pixels, written from the definition."""
    settings = RasterSettings()
    gaussians, views = cloud(120, size=0.4).to(torch.float64), camera_ring(1, 9, 11).to(torch.float64)
    rendering = render(gaussians, views, "reference", settings=settings)
    index = reference.visible(gaussians, views[0, 0], settings, 0.01)
    splats = reference.project(gaussians.select(index, (len(index),)), views[0, 0], settings)
    depths = splats.depths.tolist()
    assert depths == sorted(depths)
    assert len(depths) > 50
    stopped = 0
    for row, column in ((0, 0), (4, 5), (8, 10), (3, 7)):
        transmittance, color, depth = 1.0, torch.zeros(3, dtype=torch.float64), 0.0
        for k in range(len(depths)):
            xx, xy, yy = splats.covariances[k]
            covariance = torch.stack((torch.stack((xx, xy)), torch.stack((xy, yy))))
            offset = torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64) - splats.centers[k]
            sigma = float(0.5 * offset @ torch.linalg.solve(covariance, offset))
            alpha = min(settings.alpha_max, float(splats.opacities[k]) * math.exp(-sigma))
            if alpha < reference.ALPHA_MIN:
                continue
            if transmittance * (1 - alpha) <= reference.STOP:
                stopped += 1
                break
            weight = transmittance * alpha
            color, depth = color + weight * splats.colors[k], depth + weight * depths[k]
            transmittance *= 1 - alpha
        total = 1 - transmittance
        expected = torch.tensor([*color, total, depth / max(total, 1e-10)], dtype=torch.float64)
        planes = torch.cat((rendering.image, rendering.alpha, rendering.depth), 2)
        torch.testing.assert_close(planes[0, 0, :, row, column], expected, rtol=1e-9, atol=1e-12)
    assert stopped > 0


def test_projection_against_the_derivative_of_the_pinhole():
    """Inside the frame, 2D covariances are J Sigma J^T with J from autograd."""
    gaussians, views = cloud(40).to(torch.float64), camera_ring(3, 40, 50).to(torch.float64)
    camera = views[0, 1]
    splats = reference.project(gaussians, camera, RasterSettings())
    root = quaternion_to_matrix(gaussians.quaternions) * gaussians.scales[:, None, :]
    for n in range(40):
        center, _ = project(gaussians.means[n], camera.intrinsics, camera.extrinsics)
        if not (0 <= center[0] <= 50 and 0 <= center[1] <= 40):
            continue
        jacobian = torch.autograd.functional.jacobian(
            lambda mean: project(mean, camera.intrinsics, camera.extrinsics)[0], gaussians.means[n]
        )
        covariance = jacobian @ root[n] @ root[n].T @ jacobian.T + 0.3 * torch.eye(2, dtype=torch.float64)
        wanted = covariance[[0, 0, 1], [0, 1, 1]]
        torch.testing.assert_close(splats.covariances[n], wanted)
        torch.testing.assert_close(splats.determinants[n], torch.linalg.det(covariance))
        torch.testing.assert_close(splats.centers[n], center)
