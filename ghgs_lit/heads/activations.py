"""Activations of the raw channels of heads."""

import torch
from jaxtyping import Float
from torch import Tensor


class _Saturate(torch.autograd.Function):
    """A sigmoid or tanh whose argument is clamped; see :func:`bounded_sigmoid`."""

    @staticmethod
    def forward(ctx, x: Tensor, limit: float, symmetric: bool) -> Tensor:
        ctx.save_for_backward(x)
        ctx.limit, ctx.symmetric = limit, symmetric
        stopped = x.clamp(-limit, limit)
        return stopped.tanh() if symmetric else stopped.sigmoid()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, slope: Tensor):
        (x,) = ctx.saved_tensors
        stopped = x.clamp(-ctx.limit, ctx.limit)
        # Not y (1 - y), which has few exact digits where y is nearly 1.
        if ctx.symmetric:
            own = stopped.cosh().square().reciprocal()
        else:
            own = stopped.sigmoid() * (-stopped).sigmoid()
        # Gradient descent subtracts, so a gradient with the sign of x leads back into the limits.
        leads_back = (stopped == x) | (slope * x > 0)
        return torch.where(leads_back, slope * own, 0), None, None


#: Largest arguments of the activations; sigmoid and tanh have slopes of 4.5e-5 and 1.8e-4 there.
SIGMOID_LIMIT, TANH_LIMIT, EXP_LIMIT = 10.0, 5.0, 80.0


def bounded_sigmoid(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The sigmoid of ``x`` clamped to +-10; beyond, only gradients that lead back into the limits remain. In
    float32 a plain sigmoid is exactly 1 from 17 on, without a gradient: one step that is too large ends the
    training of a head."""
    return _Saturate.apply(x, SIGMOID_LIMIT, False)


def bounded_tanh(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The hyperbolic tangent of ``x`` clamped to +-5, with gradients as of :func:`bounded_sigmoid`."""
    return _Saturate.apply(x, TANH_LIMIT, True)


def confidence_of(raw: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """A confidence of at least 1, as in published heads, finite for any raw value."""
    return 1 + raw.clamp(max=EXP_LIMIT).exp()
