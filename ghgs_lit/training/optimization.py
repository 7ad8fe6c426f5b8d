"""Optimization: AdamW or Muon, a piecewise linear schedule over the run's budget."""

from collections.abc import Iterator
from typing import Annotated

import torch
from pydantic import Field
from torch import nn

from ghgs_lit.config.options import Amount, Index, Options, Positive, Share
from ghgs_lit.errors import require
from ghgs_lit.training.muon import Muon
from ghgs_lit.weights.checkpoint import STATE_PREFIX

BelowOne = Annotated[float, Field(ge=0, lt=1)]
#: AdamW's epsilon, added to the denominator.
EPS = 1e-8
#: Initial learning rate as a fraction of the highest one.
START_FACTOR = 0.04
#: Devices on which learning rates stay numbers: on a CPU, PyTorch's AdamW rounds a tensor to float32.
_BY_NUMBER = ("cpu", "mps")


def named_weights(module: nn.Module) -> Iterator[tuple[str, nn.Parameter]]:
    """Yield parameters with the names that configurations and messages use.

    Args:
        module: a model, or a LightningModule, in which other submodules (a loss, a renderer) may have
            weights, too.

    Yields:
        Name and parameter. Names of the model's parameters are relative to it, such as
        ``gaussian_head.conv.weight``; all others are relative to the LightningModule, such as
        ``losses.network.weight``."""
    for name, parameter in module.named_parameters():
        yield name.removeprefix(STATE_PREFIX), parameter


class Optimization(Options):
    """AdamW or Muon, with a learning rate that rises linearly to ``lr`` and then falls linearly over the
    used share of the run's budget of steps or time, whichever is larger."""

    group = "optimizer"
    lr: Positive = 1e-4
    """Highest learning rate."""
    matrix_scale: Positive | None = None
    """Learning rate of matrices, which Muon updates with orthogonal steps, in units of lr;
    null: AdamW for all parameters."""
    betas: tuple[BelowOne, BelowOne] = (0.9, 0.999)
    """AdamW's decay of the averages of the gradient and of its square."""
    weight_decay: Amount = 1e-5
    """Decoupled weight decay."""
    warmup: BelowOne = 0.01
    """Share of the run during which the learning rate rises from 0.04 lr to lr."""
    end_factor: Share = 5e-4
    """Final learning rate as a fraction of lr."""
    clip: Positive = 1.0
    """Maximum norm of the gradient."""
    freeze_until: dict[str, Share] = Field({})
    """Prefixes of parameter names: share of the run during which these parameters stay frozen."""
    skip_nonfinite: Index = 0
    """Maximum number of consecutive steps that are skipped because their loss or gradient is not finite;
    0: the run stops at the first."""

    def optimizer(self, module: nn.Module, fused: bool = True, captures: bool = True) -> torch.optim.AdamW:
        """Build the optimizer of all parameters that require gradients.

        On a GPU it counts steps on the device (``capturable``), so that a step can be captured as a CUDA
        graph; :func:`hold_rates` turns its learning rates into tensors.

        Args:
            module: a model, or a LightningModule with everything that has weights, on the training
                device.
            fused: use PyTorch's fused AdamW, the fastest. It unscales gradients (``16-mixed``) inside
                its step, which is too late for clipping.
            captures: whether Muon's steps on a GPU are captured as a CUDA graph.

        Returns:
            AdamW, or Muon if ``matrix_scale`` is set.

        Raises:
            InputError: a prefix in ``freeze_until`` matches no parameter."""
        named = list(named_weights(module))
        for prefix in self.freeze_until:
            known = any(name.startswith(prefix) for name, _ in named)
            require(known, f"optimizer.freeze_until.{prefix}", "the beginning of a parameter's name", prefix)
        parameters = [parameter for _, parameter in named if parameter.requires_grad]
        options = {name: getattr(self, name) for name in ("lr", "betas", "weight_decay")}
        on_gpu = all(parameter.device.type not in _BY_NUMBER for parameter in parameters)
        options |= {"eps": EPS, "fused": fused, "capturable": on_gpu}
        if self.matrix_scale is None:
            return torch.optim.AdamW(parameters, **options)
        return Muon(parameters, self.matrix_scale * self.lr, captures, **options)

    def drop_frozen_gradients(self, module: nn.Module, progress: float) -> None:
        """Remove the gradients of parameters that ``freeze_until`` freezes, so that the optimizer,
        including its weight decay, leaves them unchanged.

        Args:
            module: see :meth:`optimizer`.
            progress: used share of the run's budget in [0, 1]."""
        frozen = tuple(prefix for prefix, share in self.freeze_until.items() if progress < share)
        if not frozen:
            return
        for name, parameter in named_weights(module):
            if name.startswith(frozen):
                parameter.grad = None

    def factor(self, progress: float) -> float:
        """Learning rate as a fraction of ``lr``.

        Args:
            progress: used share of the run's budget; the rate is constant from 1 on."""
        if progress < self.warmup:
            return START_FACTOR + (1 - START_FACTOR) * progress / self.warmup
        fall = (progress - self.warmup) / (1 - self.warmup)
        return 1 + (self.end_factor - 1) * min(fall, 1.0)


def hold_rates(optimizer: torch.optim.Optimizer) -> None:
    """Turn learning rates into tensors on the GPU, where captured steps read what the schedule writes.

    Args:
        optimizer: see :meth:`Optimization.optimizer`; unchanged if it is not ``capturable``."""
    for group in optimizer.param_groups:
        if group["capturable"]:
            group["lr"] = torch.full((), float(group["lr"]), device=group["params"][0].device)


def convert_rates_to_numbers(checkpoint: dict) -> None:
    """Replace learning rates that are tensors (:func:`hold_rates`) by numbers.

    Args:
        checkpoint: Lightning's, with the states of optimizers and schedules; changed in place."""
    for state in checkpoint.get("optimizer_states", ()):
        for group in state["param_groups"]:
            group["lr"] = float(group["lr"])
    for state in checkpoint.get("lr_schedulers", ()):
        state["_last_lr"] = [float(rate) for rate in state["_last_lr"]]
