"""All activations of the published dense heads, of which the model uses one."""

import torch
import torch.nn.functional as F

from ghgs_lit.geometry.projection import at_least_float32
from ghgs_lit.geometry.rotations import unit
from ghgs_lit.ops.activation import confidence_of


def inverse_log(x):
    """``sign(x) (exp(|x|) - 1)``: linear near 0, exponential far away, of either sign."""
    return x.sign() * x.abs().expm1()


def _direction_and_length(x):
    direction = unit(x)
    return direction * (direction * x).sum(-1, keepdim=True).expm1()


def _inverse_log_z(x):
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
CONFIDENCES = {"expp1": confidence_of, "expp0": torch.exp, "sigmoid": torch.sigmoid}


def split_activated(raw, value, confidence="expp1"):
    """Activated values [n, h, w, c - 1] and confidence [n, h, w] (last channel) of raw channels [n,
    c, h, w]."""
    raw = at_least_float32(raw).permute(0, 2, 3, 1)
    return VALUES[value](raw[..., :-1]), CONFIDENCES[confidence](raw[..., -1])
