"""Activations that turn the raw channels of a dense head into values and a confidence."""

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ghgs_lit.errors import choice
from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.vectors import unit


def inverse_log(x: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
    """``sign(x) (exp(|x|) - 1)``: linear near 0, exponential far away, of either sign."""
    return x.sign() * x.abs().expm1()


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
        own = (
            stopped.cosh().square().reciprocal()
            if ctx.symmetric
            else stopped.sigmoid() * (-stopped).sigmoid()
        )
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


def _direction_and_length(x: Float[Tensor, "*n c"]) -> Float[Tensor, "*n c"]:
    direction = unit(x)
    return direction * (direction * x).sum(-1, keepdim=True).expm1()


def _inverse_log_z(x: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n 3"]:
    z = inverse_log(x[..., 2:])
    return torch.cat((x[..., :2] * z, z), dim=-1)


VALUES = {
    "linear": lambda x: x,
    "exp": torch.exp,
    "inv_log": inverse_log,
    "norm_exp": _direction_and_length,
    "norm": unit,
    "relu": F.relu,
    "sigmoid": torch.sigmoid,
    "xy_inv_log": _inverse_log_z,
}
CONFIDENCES = {
    "expp1": lambda c: 1 + c.clamp(max=EXP_LIMIT).exp(),
    "expp0": torch.exp,
    "sigmoid": torch.sigmoid,
}


def split_activated(
    raw: Float[Tensor, "n c h w"], value: str, confidence: str = "expp1"
) -> tuple[Float[Tensor, "n h w c-1"], Float[Tensor, "n h w"]]:
    """Activated values and confidence, float32 or wider.

    Published depth heads use ``exp``, point heads ``inv_log``, the release of the paper ``linear``; all with
    ``expp1``.

    Args:
        raw: channels of a dense head, the last one for the confidence.
        value: one of :data:`VALUES`.
        confidence: one of :data:`CONFIDENCES`.
    """
    choice("value activation", value, tuple(VALUES))
    choice("confidence activation", confidence, tuple(CONFIDENCES))
    raw = at_least_float32(raw).permute(0, 2, 3, 1)
    return VALUES[value](raw[..., :-1]), CONFIDENCES[confidence](raw[..., -1])
