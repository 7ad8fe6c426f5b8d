"""Activations that keep a gradient whatever a step has done to their head."""

import pytest
import torch

from ghgs_lit.method.heads.attributes import FootprintAttributes
from ghgs_lit.method.heads.depth import BOUNDED, bounded_depth, inverse_linear
from ghgs_lit.ops.activation import bounded_sigmoid, bounded_tanh, confidence_of, footprint_attributes

FAR_OUT = (-1e4, -90.0, -17.0, 17.0, 90.0, 1e4)


@pytest.mark.parametrize(("ours", "plain"), [(bounded_sigmoid, torch.sigmoid), (bounded_tanh, torch.tanh)])
def test_inside_the_limit_it_is_the_plain_function(ours, plain):
    x = torch.linspace(-4.9, 4.9, 41, dtype=torch.float64, requires_grad=True)
    torch.testing.assert_close(ours(x), plain(x))
    assert torch.autograd.gradcheck(ours, (x,))


@pytest.mark.parametrize("ours", [bounded_sigmoid, bounded_tanh])
@pytest.mark.parametrize("raw", FAR_OUT)
def test_a_gradient_leads_back_from_beyond_the_limit(ours, raw):
    """A plain sigmoid has a gradient of 0 from 17 on:
    one large step ended the training of a head."""
    for sign in (-1, 1):
        x = torch.tensor(raw, requires_grad=True)
        (gradient,) = torch.autograd.grad(sign * ours(x), x)
        leads_back = sign * raw > 0  # descent then moves towards 0
        assert (gradient * sign > 1e-5) if leads_back else (gradient == 0)


@pytest.mark.parametrize("name", list(BOUNDED))
@pytest.mark.parametrize("raw", [-90.0, 90.0])
def test_a_saturated_depth_recovers(name, raw):
    """Adam brings a raw value back that a step of an adversarial learning rate sent away."""
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
    """Without one, as published, as far as the network says: 5 cm for a raw value of 1."""
    raws = [torch.full(shape, 40.0) for shape in ((1, 3), (1, 3), (1, 4), (1,), (1,))]
    for limit, expected in ((0.05, 0.05), (0.2, 0.2), (None, 2.0)):
        offset = attributes(*raws, limit=limit)[0]
        torch.testing.assert_close(offset, torch.full((1, 3), expected), rtol=0.03, atol=0)


@pytest.mark.parametrize("raw", FAR_OUT)
def test_saturated_attributes_keep_a_gradient(raw):
    """Offsets had none from 10 on, scales and opacities none from 20 on."""
    raws = [torch.full(shape, raw, requires_grad=True) for shape in ((1, 3), (1, 3), (1, 4), (1,))]
    values = attributes(*raws, torch.full((1,), 0.004))
    towards_zero = 1.0 if raw > 0 else -1.0
    for name, x, value in zip(("offset", "scale", "rotation", "opacity"), raws, values, strict=True):
        assert value.isfinite().all(), name
        if name != "rotation":
            (gradient,) = torch.autograd.grad(towards_zero * value.sum(), x)
            assert (gradient * towards_zero > 0).all(), name


def test_the_rotation_near_minus_identity_has_a_bounded_gradient():
    """Raw values near (-1, 0, 0, 0) make the zero quaternion: there the gradient grows
    as 1 / |q|."""
    rotation = torch.tensor([[-1.0, 1e-9, 0.0, 0.0]], requires_grad=True)
    zeros = torch.zeros(1, 3)
    quaternions = attributes(zeros, zeros, rotation, torch.zeros(1), torch.ones(1))[2]
    (gradient,) = torch.autograd.grad(quaternions[0, 2], rotation)
    assert gradient.abs().max() <= 10.0 + 1e-4


def test_the_release_s_depth_has_a_finite_gradient_at_its_pole():
    """At -1e-8 the depth is infinite and replaced; replacing the result left a gradient of NaN."""
    x = torch.tensor([-1e-8, 0.1], requires_grad=True)
    depth = inverse_linear(x)
    assert depth[0].isinf()
    torch.where(depth.isfinite(), depth, 1.0).sum().backward()
    assert x.grad[0] == 0
    assert x.grad[1] == pytest.approx(-100, rel=1e-4)


def test_a_confidence_of_any_raw_value_is_finite():
    """Published heads take an exponential, which overflows from 89 on."""
    assert confidence_of(torch.tensor([-1e4, 0.0, 100.0, 1e4])).isfinite().all()
