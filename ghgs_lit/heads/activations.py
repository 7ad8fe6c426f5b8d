"""Activations that turn the raw channels of a head into values and a confidence."""

import torch
from jaxtyping import Float
from torch import Tensor


class _Saturate(torch.autograd.Function):
    """A sigmoid or a hyperbolic tangent whose argument stops at a limit; see :func:`bounded`."""

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
        # Not y (1 - y), which has lost most digits where y is nearly 1.
        if ctx.symmetric:
            own = stopped.cosh().square().reciprocal()
        else:
            own = stopped.sigmoid() * (-stopped).sigmoid()
        # Gradient descent subtracts: a gradient of the sign of x leads back.
        leads_back = (stopped == x) | (slope * x > 0)
        return torch.where(leads_back, slope * own, 0), None, None


#: Arguments at which activations stop: their slope there is 4.5e-5 and 1.8e-4.
SIGMOID_LIMIT, TANH_LIMIT, EXP_LIMIT = 10.0, 5.0, 80.0


def bounded_sigmoid(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The sigmoid of ``x``, which stops at +-10 and keeps a gradient that leads back from beyond.

    In float32 a plain sigmoid is exactly 1 from 17 on and has no gradient left, so that one step that is too
    large would end the training of a head.
    """
    return _Saturate.apply(x, SIGMOID_LIMIT, False)


def bounded_tanh(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """The hyperbolic tangent of ``x``, which stops at +-5; otherwise as :func:`bounded_sigmoid`."""
    return _Saturate.apply(x, TANH_LIMIT, True)


def confidence_of(raw: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """A confidence of at least 1, as published heads have it; finite whatever the raw value."""
    return 1 + raw.clamp(max=EXP_LIMIT).exp()
