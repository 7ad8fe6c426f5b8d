"""Optimization: AdamW or Muon, a linear schedule over the run's budget, gradient clipping."""

from collections.abc import Iterator
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn

from ghgs_lit.config.options import Amount, Index, Options, Positive, Share
from ghgs_lit.errors import require
from ghgs_lit.training.muon import Muon
from ghgs_lit.weights.checkpoint import STATE_PREFIX

BelowOne = Annotated[float, Field(ge=0, lt=1)]
#: AdamW's term in the denominator.
EPS = 1e-8
#: The first learning rate as a fraction of the highest one.
START_FACTOR = 0.04
#: Where a learning rate is a number: PyTorch's AdamW rounds a tensor's to float32 on a CPU.
_BY_NUMBER = ("cpu", "mps")


def named_weights(module: nn.Module) -> Iterator[tuple[str, nn.Parameter]]:
    """Parameters by the names that configurations and messages use.

    Args:
        module: a model, or a LightningModule, in which other parts than the model (a loss, a
            renderer) can have weights, too.

    Returns:
        Names and parameters: those of the model by their names in it, such as
        ``gaussian_head.conv.weight``, all others by their names in the LightningModule, such as
        ``losses.network.weight``."""
    for name, parameter in module.named_parameters():
        yield name.removeprefix(STATE_PREFIX), parameter


class Optimization(Options):
    """AdamW or Muon, with a learning rate that rises linearly to ``lr`` and then falls linearly,
    over the used share of the run's budget of steps or of time, whichever is larger."""

    group = "optimizer"
    lr: Positive = 1e-4
    """Highest learning rate."""
    matrix_scale: Positive | None = None
    """Learning rate of matrices, which take Muon's orthogonal steps, in units of lr;
    null: AdamW for all."""
    betas: tuple[BelowOne, BelowOne] = (0.9, 0.999)
    """AdamW's averages of the gradient and of its square."""
    weight_decay: Amount = 1e-5
    """Decoupled weight decay."""
    warmup: BelowOne = 0.01
    """Share of the run in which the learning rate rises from 0.04 lr to lr."""
    end_factor: Share = 5e-4
    """Last learning rate as a fraction of lr."""
    clip: Positive = 1.0
    """Maximum norm of the gradient."""
    freeze_until: dict[str, Share] = Field({})
    """Beginning of parameter names: share of the run in which these parameters stay unchanged."""
    skip_nonfinite: Index = 0
    """Steps in a row that are not finite and are skipped before the run stops;
    0: it stops at the first."""

    def optimizer(self, module: nn.Module, fused: bool = True, captures: bool = True) -> torch.optim.AdamW:
        """The optimizer of all trained parameters.

        On a GPU it counts steps there (``capturable``), so that its step can be captured as a CUDA
        graph; the learning rates become tensors by :func:`hold_rates`.

        Args:
            module: a model, or a LightningModule with all that has weights,
                on the device of the training.
            fused: PyTorch's fastest AdamW. It undoes the scaling of a loss (``16-mixed``) inside
                its step, too late for clipping gradients.
            captures: whether Muon's steps are captured as a CUDA graph on a GPU.

        Returns:
            AdamW, or Muon where there is a ``matrix_scale``.

        Raises:
            InputError: ``freeze_until`` names no parameter."""
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
        """Remove gradients of frozen parameters, so that the optimizer leaves them unchanged, also
        by weight decay.

        Args:
            module: that of :meth:`optimizer`.
            progress: used share of the run's budget in [0, 1]."""
        frozen = tuple(prefix for prefix, share in self.freeze_until.items() if progress < share)
        if not frozen:
            return
        for name, parameter in named_weights(module):
            if name.startswith(frozen):
                parameter.grad = None

    def clip_gradients(self, module: nn.Module) -> Tensor:
        """Scale all gradients so that their common norm is at most ``clip``.

        Args:
            module: that of :meth:`optimizer`.

        Returns:
            The norm before, without dimensions, on the module's device, without a synchronisation."""
        return nn.utils.clip_grad_norm_(module.parameters(), self.clip, foreach=True)

    def factor(self, progress: float) -> float:
        """Learning rate as a fraction of ``lr``.

        Args:
            progress: used share of the run's budget in [0, 1], or more."""
        if progress < self.warmup:
            return START_FACTOR + (1 - START_FACTOR) * progress / self.warmup
        fall = (progress - self.warmup) / (1 - self.warmup)
        return 1 + (self.end_factor - 1) * min(fall, 1.0)


def hold_rates(optimizer: torch.optim.Optimizer) -> None:
    """Hold learning rates as tensors on a GPU:
    a captured step reads what the schedule writes there.

    Args:
        optimizer: of :meth:`Optimization.optimizer`; unchanged where it is not ``capturable``."""
    for group in optimizer.param_groups:
        if group["capturable"]:
            group["lr"] = torch.full((), float(group["lr"]), device=group["params"][0].device)


def plain_rates(checkpoint: dict) -> None:
    """Put numbers in the place of learning rates that are tensors (:func:`hold_rates`).

    Args:
        checkpoint: with the states of Lightning's optimizers and schedules."""
    for state in checkpoint.get("optimizer_states", ()):
        for group in state["param_groups"]:
            group["lr"] = float(group["lr"])
    for state in checkpoint.get("lr_schedulers", ()):
        state["_last_lr"] = [float(rate) for rate in state["_last_lr"]]
