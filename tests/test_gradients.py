"""Gradients of the package's differentiable functions compared with finite differences, in float64.

Those of unit vectors, Chamfer, SSIM, a dense head and the reference renderer are tested together with
their values (``grep -rl gradcheck tests``), the compiled renderer against the reference. Nothing else has
a gradient: bounds, photo-consistency, relative depths and lenses are constant in a training step, which
one test checks.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Generator, Tensor
from torch.autograd import gradcheck

from ghgs_lit.geometry.masks import relative_bounds, relative_depth
from ghgs_lit.geometry.projection import inverse_intrinsics, project, unproject, world_to_camera
from ghgs_lit.geometry.rotations import quaternion_to_matrix
from ghgs_lit.geometry.undistortion import undistorting_grid
from ghgs_lit.geometry.unprojection import subject_tokens
from ghgs_lit.losses import terms
from ghgs_lit.method.bounds import SubjectBox, VisualHull
from ghgs_lit.method.heads.attributes import FootprintAttributes, release_attributes
from ghgs_lit.method.heads.depth import BOUNDED, bounded_depth, inverse_linear
from ghgs_lit.method.plan.window import Span, Window
from ghgs_lit.method.recalibration import Neighborhood, SemanticAttention
from ghgs_lit.ops.activation import confidence_of, footprint_attributes
from ghgs_lit.ops.photo_consistency import photo_consistency
from ghgs_lit.types import DepthBounds, DepthMaps
from tests.helpers.scenes import make_batch, training_batch
from tests.helpers.training import Standin, flat_renderer


def values(*shape: int, low: float = -1.0, high: float = 1.0, seed: int = 0) -> Tensor:
    g = Generator().manual_seed(seed + sum(shape))
    return (low + (high - low) * torch.rand(shape, generator=g, dtype=torch.float64)).requires_grad_()


def camera() -> tuple[Tensor, Tensor]:
    """Intrinsics with skew and extrinsics of a camera that faces the origin."""
    intrinsics = torch.tensor([[40.0, 0.7, 15.0], [0, 42, 17], [0, 0, 1]], dtype=torch.float64)
    extrinsics = torch.eye(4, dtype=torch.float64)
    extrinsics[:3, :3] = quaternion_to_matrix(torch.tensor([0.9, 0.2, -0.3, 0.1], dtype=torch.float64))
    extrinsics[:3, 3] = torch.tensor([0.1, -0.2, 2.5])
    return intrinsics.requires_grad_(), extrinsics.requires_grad_()


def covariance(quaternions: Tensor, scales: Tensor) -> Tensor:
    root = quaternion_to_matrix(quaternions) * scales[:, None]
    return root @ root.mT


def token_depths(depth: Tensor) -> tuple[Tensor, Tensor]:
    valid = torch.ones(1, 1, 8, 8, dtype=torch.bool)
    valid[..., :3, :5] = False
    pixels, found, any_valid = subject_tokens(DepthMaps(depth, valid, depth.detach()), 4)
    return found[any_valid], pixels


def relative(near: Tensor, far: Tensor) -> Tensor:
    masks = torch.ones(1, 1, 3, 4, dtype=torch.bool)
    masks[..., 0, :2] = False
    return relative_bounds(DepthBounds(near, far), masks)


def resize_to(source: Window, target: Window):
    return lambda maps: source.resize(maps, target)


WHOLE, PART = Window.whole((4, 5)), Window(Span(1, 4, 4), Span(0, 4, 5))
TARGET = Window(Span(3, 7, 9), Span(0, 5, 11))
#: Functions with inputs; raw values keep a distance from kinks of activations.
FUNCTIONS = {
    "confidence": (confidence_of, (values(6),)),
    **{
        f"depth {name}": (
            lambda x, near, far, name=name: bounded_depth(x, near, far, name),
            (values(6, low=-4, high=4), values(6, low=1.5, high=2), values(6, low=2.2, high=3)),
        )
        for name in BOUNDED
    },
    "depth inverse_linear": (inverse_linear, (values(6, low=0.2),)),
    "attributes footprint": (
        lambda *raws: footprint_attributes(*raws, FootprintAttributes().constants(0.05, 0.0)),
        (values(4, 3), values(4, 3), values(4, 4), values(4), values(4, low=0.01, high=0.02)),
    ),
    "attributes release": (
        release_attributes,
        (values(4, 3), values(4, 3), values(4, 4), values(4), values(4, low=0.01, high=0.02)),
    ),
    "rotation": (quaternion_to_matrix, (values(5, 4),)),
    "covariance": (covariance, (values(5, 4), values(5, 3, low=0.1))),
    "projection": (project, (values(6, 3), *camera())),
    "camera coordinates": (world_to_camera, (values(6, 3), camera()[1])),
    "unprojection": (unproject, (values(6, 2, high=30.0), values(6, low=1.0, high=3.0), *camera())),
    "inverse intrinsics": (inverse_intrinsics, (camera()[0],)),
    "token points": (token_depths, (values(1, 1, 8, 8, low=1.0, high=2.0),)),
    "relative bounds": (
        relative,
        (values(1, 1, 3, 4, low=1.0, high=2.0), values(1, 1, 3, 4, low=2.0, high=3.0)),
    ),
    "resampling of whole maps": (resize_to(WHOLE, Window.whole((9, 11))), (values(1, 2, 4, 5),)),
    "resampling of a window": (resize_to(PART, TARGET), (values(1, 2, 3, 4),)),
}


@pytest.mark.parametrize("name", list(FUNCTIONS))
def test_a_gradient_is_that_of_finite_differences(name):
    """A wrong factor in a gradient slows down training and has no other symptom."""
    function, inputs = FUNCTIONS[name]
    assert gradcheck(function, inputs)


@pytest.mark.parametrize("similarity", ["none", "log", "product", "product_clamped"])
def test_the_gradient_of_attention_is_that_of_finite_differences(similarity):
    """For every use of the similarity."""
    torch.manual_seed(0)
    block = SemanticAttention(16, 2, similarity).double()
    index = torch.stack([torch.randperm(6)[:3] for _ in range(6)])
    cosines = None if similarity == "none" else values(6, 3, low=0.1).detach()
    assert gradcheck(lambda x: block(x, Neighborhood(index, cosines)), (values(6, 16),), fast_mode=True)


@pytest.mark.parametrize("name", ["render_l1", "render_ssim", "chamfer", "depth"])
def test_the_gradient_of_a_loss_is_that_of_finite_differences(name):
    """With respect to the outputs of the model and the renderer."""
    batch = training_batch(size=14)
    masks = batch.masks
    points = values(*masks.shape, 3)
    depth = values(*masks.shape, low=1.0, high=2.0)
    image = values(*batch.targets.images.shape, low=0.0)
    truth = batch.targets.images.double() * 0.3

    prediction = Standin()(batch)
    rendering = flat_renderer(prediction.gaussians, batch.targets.cameras)
    batch = replace(
        batch,
        targets=replace(batch.targets, images=truth),
        depths=batch.depths.double(),
        body_vertices=[vertices.double() for vertices in batch.body_vertices],
    )

    def loss(points: Tensor, depth: Tensor, image: Tensor) -> Tensor:
        found = replace(prediction, points=replace(prediction.points, pixels=points), depth=depth)
        return getattr(terms, name)(found, replace(rendering, image=image), batch)

    assert gradcheck(loss, (points, depth, image), fast_mode=True)


def test_what_is_constant_in_a_training_step_has_no_gradient():
    """Bounds, photo-consistency, relative depths and lenses are inputs of networks."""
    batch = make_batch(views=3, height=28, width=28)
    batch = replace(batch, images=batch.images.clone().requires_grad_())
    near = batch.depths.clone().requires_grad_()
    bounds = DepthBounds(near - 0.2, near + 0.2)
    assert not photo_consistency(batch, bounds, 2).requires_grad
    assert not relative_depth(near, batch.masks).requires_grad
    for stage in (SubjectBox(), VisualHull()):
        assert not stage(batch).near.requires_grad
    assert not undistorting_grid(np.diag([20.0, 20.0, 1.0]), np.zeros(5), 16, 16).requires_grad
