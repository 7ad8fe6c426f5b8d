"""How the weights are trained: AdamW or Muon, a linear schedule over the run's budget, gradient clipping."""

from typing import Annotated

import torch
from pydantic import Field
from torch import nn

from ghgs_lit.config.options import Amount, Index, Options, Positive, Share
from ghgs_lit.errors import require
from ghgs_lit.training.muon import Muon

BelowOne = Annotated[float, Field(ge=0, lt=1)]
#: AdamW's term in the denominator.
EPS = 1e-8
#: The first learning rate as a fraction of the highest one.
START_FACTOR = 0.04


class Optimization(Options):
    """AdamW or Muon, whose learning rate rises linearly to ``lr`` and then falls linearly.

    The schedule depends on the share of the run's budget that is used: of steps or of time, whichever is
    larger.
    """

    group = "optimizer"
    lr: Positive = 1e-4
    """Highest learning rate."""
    matrix_scale: Positive | None = None
    """Learning rate of matrices, which take Muon's orthogonal steps, in units of lr; null: AdamW for all."""
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
    """Steps in a row that are not finite and are skipped before the run stops; 0: it stops at the first."""

    def optimizer(self, model: nn.Module, fused: bool = True) -> torch.optim.AdamW:
        """The optimizer of the parameters of ``model`` that are trained.

        ``fused`` is PyTorch's fastest AdamW. It undoes the scaling of a loss (``16-mixed``) inside its step,
        where gradients cannot be clipped any more. InputError: ``freeze_until`` names no parameter.
        """
        names = [name for name, _ in model.named_parameters()]
        for prefix in self.freeze_until:
            known = any(name.startswith(prefix) for name in names)
            require(known, f"optimizer.freeze_until.{prefix}", "the beginning of a parameter's name", prefix)
        parameters = [p for p in model.parameters() if p.requires_grad]
        options = {
            "lr": self.lr,
            "betas": self.betas,
            "eps": EPS,
            "weight_decay": self.weight_decay,
            "fused": fused,
        }
        if self.matrix_scale is None:
            return torch.optim.AdamW(parameters, **options)
        return Muon(parameters, matrix_lr=self.matrix_scale * self.lr, **options)

    def drop_frozen_gradients(self, model: nn.Module, progress: float) -> None:
        """Remove the gradients of the parameters that are frozen at the share ``progress`` of the run.

        The optimizer then leaves these parameters unchanged, without weight decay.
        """
        frozen = tuple(prefix for prefix, share in self.freeze_until.items() if progress < share)
        if not frozen:
            return
        for name, parameter in model.named_parameters():
            if name.startswith(frozen):
                parameter.grad = None

    def factor(self, progress: float) -> float:
        """Learning rate as a fraction of ``lr`` when the share ``progress`` of the budget is used."""
        if progress < self.warmup:
            return START_FACTOR + (1 - START_FACTOR) * progress / self.warmup
        fall = (progress - self.warmup) / (1 - self.warmup)
        return 1 + (self.end_factor - 1) * min(fall, 1.0)
